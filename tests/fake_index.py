"""A Python package index in a thread of this process: enough of it to upload with uv, and to install."""

import base64
import threading
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

TOKEN = "pypi-of-the-fake-index"


class FakeIndex:
    """`with FakeIndex() as index:` serves until the block ends.

    Attributes:
        url: Its address.
        files: Contents of the uploaded files, by name.
    """

    def __init__(self):
        self.files = {}
        handler = type("Handler", (_Handler,), {"index": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self):
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()

    def environment(self, token=TOKEN):
        """Variables of an upload with uv."""
        return {"UV_PUBLISH_URL": f"{self.url}/upload/", "UV_PUBLISH_TOKEN": token, "NO_PROXY": "127.0.0.1"}

    def upload(self, headers, body):
        """Status of the answer to an upload: a form with a field `content`, which is the file."""
        credentials = base64.b64encode(f"__token__:{TOKEN}".encode()).decode()
        if headers.get("Authorization") != f"Basic {credentials}":
            return 403
        form = message_from_bytes(f"Content-Type: {headers['Content-Type']}\r\n\r\n".encode() + body)
        for part in form.get_payload():
            if part.get_param("name", header="Content-Disposition") == "content":
                self.files[part.get_filename()] = part.get_payload(decode=True)
        return 200

    def page(self, path):
        """A file, or the page of links to all of them; None for any other path."""
        folder, _, name = path.lstrip("/").partition("/")
        if folder == "files":
            return self.files.get(name)
        return "".join(f'<a href="/files/{name}">{name}</a>' for name in self.files).encode()


class _Handler(BaseHTTPRequestHandler):
    index: FakeIndex
    protocol_version = "HTTP/1.1"

    def do_POST(self):  # noqa: N802  (the server's name)
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self._answer(self.index.upload(self.headers, body), b"")

    def do_GET(self):  # noqa: N802
        content = self.index.page(self.path)
        self._answer(200 if content is not None else 404, content or b"")

    do_HEAD = do_GET  # noqa: N815

    def _answer(self, status, content):
        self.send_response(status)
        self.send_header("Content-Type", "text/html" if "/files/" not in self.path else "application/zip")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, *_): ...
