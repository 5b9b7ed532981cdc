"""A Hugging Face Hub in a thread of this process: enough of it for LeRobot's and huggingface_hub's clients.

It keeps repositories of models and datasets in memory.
"""

import base64
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

import huggingface_hub
from huggingface_hub import constants, hf_api
from lerobot.datasets import dataset_metadata, lerobot_dataset

TOKEN = "hf_of_the_fake_hub"
USER = "tester"


def digest(content):
    return hashlib.sha1(content).hexdigest()


class Repo:
    """Files by path, of the branch `main` and of tags."""

    def __init__(self, files=()):
        self.revisions = {"main": dict(files)}

    @staticmethod
    def commit(files):
        return digest(json.dumps(sorted((path, digest(content)) for path, content in files.items())).encode())

    def files(self, revision="main"):
        """The files of a branch, a tag or a commit; None if there is none."""
        commits = {self.commit(files): files for files in self.revisions.values()}
        return self.revisions.get(revision, commits.get(revision))


class FakeHub:
    """Serves `repos`, {("dataset" or "model", "user/name"): Repo}, until the end of a `with` block."""

    def __init__(self):
        self.repos = {}
        self._lock = threading.Lock()
        handler = type("Handler", (_Handler,), {"hub": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self):
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()

    def connect(self, patch, home, token=TOKEN):
        """Sends the clients of this process here, with their caches in the folder `home`, best a new one."""
        settings = {
            "ENDPOINT": self.url,
            "HUGGINGFACE_CO_URL_TEMPLATE": self.url + "/{repo_id}/resolve/{revision}/{filename}",
            "HF_HUB_CACHE": str(home / "hub"),
            "HF_TOKEN_PATH": str(home / "token"),
            "HF_HUB_OFFLINE": False,
            "HF_HUB_DISABLE_XET": True,
            "HF_HUB_DISABLE_TELEMETRY": True,
        }
        for name, value in settings.items():
            patch.setattr(constants, name, value)
        patch.setattr(hf_api.api, "endpoint", self.url)
        # The clients' own check of a card goes to a fixed address of the real Hub, even from here.
        patch.setattr(huggingface_hub.RepoCard, "validate", lambda *_, **__: None)
        patch.setattr(dataset_metadata, "HF_LEROBOT_HOME", home / "lerobot")
        for module in (dataset_metadata, lerobot_dataset):
            patch.setattr(module, "HF_LEROBOT_HUB_CACHE", home / "lerobot" / "hub")
        patch.setenv("NO_PROXY", "127.0.0.1")
        patch.setenv("HF_TOKEN", token or "")
        huggingface_hub.close_session()  # of another proxy

    def answer(self, method, path, body, token):
        """Status, headers and content of the answer to a request."""
        if path == "/api/validate-yaml":
            return _json({"errors": [], "warnings": []})
        if method in ("POST", "DELETE") and token != TOKEN:
            return _error(403, "Forbidden: you do not have the required rights")
        with self._lock:
            if path == "/api/repos/create":
                return self._create(json.loads(body))
            if match := re.fullmatch(r"/api/(model|dataset)s/([^/]+/[^/]+)(?:/(.*))?", path):
                kind, repo_id, rest = match.groups()
                action, _, rest = (rest or "revision/main").partition("/")
            else:
                kind, repo_id, rest = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/(.+)", path).groups()
                kind, action = "dataset" if kind else "model", "resolve"
            repo = self.repos.get((kind, repo_id))
            if repo is None:
                return _error(404, "Repository not found", "RepoNotFound")
            handle = getattr(self, f"_{method.replace('HEAD', 'GET').lower()}_{action}")
            return handle(repo, rest, body)

    def _create(self, request):
        kind, repo_id = request.get("type", "model"), f"{request['organization'] or USER}/{request['name']}"
        url = f"{self.url}/{'datasets/' if kind == 'dataset' else ''}{repo_id}"
        if (kind, repo_id) in self.repos:
            return _json({"error": "You already created this repo", "url": url}, 409)
        self.repos[kind, repo_id] = Repo()
        return _json({"url": url, "id": repo_id, "name": repo_id})

    def _get_revision(self, repo, revision, _):
        files = repo.files(revision)
        if files is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        siblings = [{"rfilename": path} for path in files]
        return _json({"id": "any/name", "sha": repo.commit(files), "tags": [], "siblings": siblings})

    def _get_refs(self, repo, *_):
        refs = {"branches": [], "tags": [], "converts": []}
        for name, files in repo.revisions.items():
            kind, folder = ("branches", "heads") if name == "main" else ("tags", "tags")
            ref = {"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": repo.commit(files)}
            refs[kind].append(ref)
        return _json(refs)

    def _get_tree(self, repo, revision, _):
        files = repo.files(revision).items()
        entries = [{"path": path, "size": len(content), "oid": digest(content)} for path, content in files]
        return _json([{"type": "file", **entry} for entry in entries])

    def _get_resolve(self, repo, rest, _):
        revision, _, path = rest.partition("/")
        files = repo.files(revision)
        if files is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        commit, content = repo.commit(files), files.get(path)
        if content is None:
            return _error(404, "Entry not found", "EntryNotFound", {"X-Repo-Commit": commit})
        return 200, {"ETag": f'"{digest(content)}"', "X-Repo-Commit": commit}, content

    def _post_preupload(self, repo, rest, body):
        paths = [file["path"] for file in json.loads(body)["files"]]
        files = [{"path": path, "uploadMode": "regular", "shouldIgnore": False} for path in paths]
        return _json({"files": files})

    def _post_commit(self, repo, branch, body):
        files = dict(repo.files(branch))
        for operation in map(json.loads, body.splitlines()):
            value = operation["value"]
            if operation["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif operation["key"] == "deletedFile":
                del files[value["path"]]
        repo.revisions[branch] = files
        commit = repo.commit(files)
        url = f"{self.url}/any/name/commit/{commit}"
        return _json({"success": True, "commitOid": commit, "commitUrl": url})

    def _post_tag(self, repo, branch, body):
        repo.revisions[json.loads(body)["tag"]] = repo.files(branch)
        return _json({})

    def _delete_tag(self, repo, tag, _):
        if repo.revisions.pop(tag, None) is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        return _json({})


def _json(contents, status=200):
    return status, {"Content-Type": "application/json"}, json.dumps(contents).encode()


def _error(status, message, code=None, headers=None):
    headers = {**(headers or {}), "X-Error-Message": message, **({"X-Error-Code": code} if code else {})}
    _, kind, content = _json({"error": message})
    return status, {**kind, **headers}, content


class _Handler(BaseHTTPRequestHandler):
    hub: FakeHub
    protocol_version = "HTTP/1.1"

    def _answer(self):
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        try:
            path = unquote(urlsplit(self.path).path)
            status, headers, content = self.hub.answer(self.command, path, body, token)
        except Exception as error:
            status, headers, content = _error(500, f"{self.command} {self.path}: {error!r}")
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    do_GET = do_HEAD = do_POST = do_DELETE = _answer  # noqa: N815  (the server's names)

    def log_message(self, *_): ...
