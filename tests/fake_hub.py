"""A Hugging Face Hub in a thread of this process: enough of it for LeRobot's and huggingface_hub's clients.

It keeps repositories of models and datasets in memory. A client runs in a process of its own, with the
variables of `FakeHub.environment`, because huggingface_hub reads them when it is imported.
"""

import base64
import hashlib
import json
import os
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit

TOKEN = "hf_of_the_fake_hub"
USER = "tester"

# The clients' own check of a card goes to a fixed address of the real Hub, even from here.
WITHOUT_CARD_CHECK = "from huggingface_hub import RepoCard; RepoCard.validate = lambda *_, **__: None; "


def digest(content):
    return hashlib.sha1(content).hexdigest()


class Repo:
    """Commits, and the branches and tags that name them."""

    def __init__(self, visibility):
        self.visibility = visibility
        self.commits = {}  # id to {path: content}, oldest first
        self.branches, self.tags = {}, {}
        self.commit("main", {})

    def commit(self, branch, files):
        parent = self.branches.get(branch, "")
        summary = json.dumps([parent, len(self.commits), sorted((p, digest(c)) for p, c in files.items())])
        name = digest(summary.encode())
        self.commits[name] = files
        self.branches[branch] = name
        return name

    def resolve(self, revision):
        """The commit of a branch, a tag or its own name; None if there is none."""
        name = self.tags.get(revision) or self.branches.get(revision) or revision
        return name if name in self.commits else None

    def files(self, revision="main"):
        return self.commits[self.resolve(revision)]


class FakeHub:
    """`with FakeHub() as hub:` serves until the block ends.

    Attributes:
        url: Its address.
        repos: {("dataset" or "model", "user/name"): Repo}.
        refused: A regular expression; requests in whose method and path it is found are refused.
    """

    def __init__(self):
        self.repos = {}
        self.refused = None
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

    def environment(self, home, token=TOKEN):
        """Variables of a client whose caches are in the folder `home`, which is best a new one."""
        ours = re.compile("HF_|HUGGING|LEROBOT_|TRANSFORMERS_OFFLINE")
        kept = {name: value for name, value in os.environ.items() if not ours.match(name)}
        variables = {
            **kept,
            "HOME": str(home),
            "HF_HOME": str(home / "huggingface"),
            "HF_LEROBOT_HOME": str(home / "lerobot"),
            "HF_ENDPOINT": self.url,
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "NO_PROXY": "127.0.0.1",
        }
        return variables if token is None else {**variables, "HF_TOKEN": token}

    def answer(self, method, path, query, body, token):
        """Status, headers and content of the answer to a request."""
        if token not in (None, TOKEN):
            return _error(401, "Invalid credentials in Authorization header")
        if path == "/api/whoami-v2":
            if token is None:
                return _error(401, "Invalid username or password.")
            return _json({"type": "user", "name": USER, "orgs": []})
        if path == "/api/validate-yaml":
            return _json({"errors": [], "warnings": []})
        if self.refused and re.search(self.refused, f"{method} {path}"):
            return _error(422, "This Hub does not do that")
        if method in ("POST", "DELETE") and token is None:
            return _error(403, "Forbidden: you do not have the required rights")
        with self._lock:
            if path == "/api/repos/create":
                return self._create(json.loads(body))
            if match := re.fullmatch(r"/api/(model|dataset)s/([^/]+/[^/]+)(?:/(.*))?", path):
                kind, repo_id, rest = match.groups()
                action, _, rest = (rest or "revision/main").partition("/")
            elif match := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/(.+)", path):
                kind, repo_id, rest = "dataset" if match[1] else "model", *match.groups()[1:]
                action = "resolve"
            else:
                return _error(404, f"No such address: {path}")
            repo = self.repos.get((kind, repo_id))
            if repo is None:
                return _error(404, "Repository not found", "RepoNotFound")
            handle = getattr(self, f"_{method.replace('HEAD', 'GET').lower()}_{action.replace('-', '_')}")
            return handle(repo, repo_id, rest, query, body)

    def _create(self, request):
        kind, repo_id = request.get("type", "model"), f"{request['organization'] or USER}/{request['name']}"
        url = f"{self.url}/{'datasets/' if kind == 'dataset' else ''}{repo_id}"
        if (kind, repo_id) in self.repos:
            return _json({"error": "You already created this repo", "url": url}, 409)
        self.repos[kind, repo_id] = Repo(request.get("visibility", "public"))
        return _json({"url": url, "id": repo_id, "name": repo_id})

    # Reading

    def _get_revision(self, repo, repo_id, rest, *_):
        commit = repo.resolve(unquote(rest))
        if commit is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        siblings = [{"rfilename": path} for path in repo.commits[commit]]
        is_private = repo.visibility == "private"
        return _json({"id": repo_id, "sha": commit, "private": is_private, "tags": [], "siblings": siblings})

    def _get_refs(self, repo, *_):
        def listed(names, kind):
            return [
                {"name": name, "ref": f"refs/{kind}/{name}", "targetCommit": commit}
                for name, commit in names.items()
            ]

        return _json(
            {"branches": listed(repo.branches, "heads"), "tags": listed(repo.tags, "tags"), "converts": []}
        )

    def _get_tree(self, repo, repo_id, rest, query, _):
        revision, _, folder = rest.partition("/")
        commit, start = repo.resolve(unquote(revision)), f"{folder}/" if folder else ""
        if commit is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        below = {path: content for path, content in repo.commits[commit].items() if path.startswith(start)}
        if folder and not below:
            return _error(404, "No such folder", "EntryNotFound")
        files = [
            {"type": "file", "path": path, "size": len(content), "oid": digest(content)}
            for path, content in below.items()
        ]
        if query.get("recursive", ["false"])[0].lower() not in ("true", "1"):
            folders = {
                start + path[len(start) :].split("/")[0] for path in below if "/" in path[len(start) :]
            }
            files = [file for file in files if "/" not in file["path"][len(start) :]]
            files += [{"type": "directory", "path": path, "oid": digest(path.encode())} for path in folders]
        return _json(files)

    def _get_resolve(self, repo, repo_id, rest, *_):
        revision, _, path = rest.partition("/")
        commit = repo.resolve(unquote(revision))
        if commit is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        content = repo.commits[commit].get(path)
        if content is None:
            return _error(404, "Entry not found", "EntryNotFound", {"X-Repo-Commit": commit})
        return 200, {"ETag": f'"{digest(content)}"', "X-Repo-Commit": commit}, content

    # Writing

    def _post_preupload(self, repo, repo_id, rest, query, body):
        files = [
            {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False}
            for file in json.loads(body)["files"]
        ]
        return _json({"files": files})

    def _post_commit(self, repo, repo_id, rest, query, body):
        branch = unquote(rest)
        if branch not in repo.branches:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        files = dict(repo.files(branch))
        for line in body.splitlines():
            operation = json.loads(line)
            value = operation["value"]
            if operation["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif operation["key"] == "deletedFile":
                if value["path"] not in files:
                    return _error(404, "Entry not found", "EntryNotFound")
                del files[value["path"]]
            elif operation["key"] == "deletedFolder":
                files = {p: c for p, c in files.items() if not p.startswith(value["path"].rstrip("/") + "/")}
        commit = repo.commit(branch, files)
        return _json(
            {"success": True, "commitOid": commit, "commitUrl": f"{self.url}/{repo_id}/commit/{commit}"}
        )

    def _post_branch(self, repo, repo_id, rest, query, body):
        start = repo.resolve(json.loads(body or "{}").get("startingPoint", "main"))
        return self._name(repo.branches, unquote(rest), start)

    def _post_tag(self, repo, repo_id, rest, query, body):
        return self._name(repo.tags, json.loads(body)["tag"], repo.resolve(unquote(rest)))

    def _name(self, names, name, commit):
        if commit is None:
            return _error(404, "Invalid rev id", "RevisionNotFound")
        if name in names:
            return _error(409, "Reference already exists")
        names[name] = commit
        return _json({})

    def _delete_tag(self, repo, repo_id, rest, *_):
        if repo.tags.pop(unquote(rest), None) is None:
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
        address = urlsplit(self.path)
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ") or None
        try:
            status, headers, content = self.hub.answer(
                self.command, unquote(address.path), parse_qs(address.query), body, token
            )
        except Exception as error:
            status, headers, content = _error(500, f"{self.command} {self.path}: {error!r}")
        first, last = 0, len(content)
        if status == 200 and (part := re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))):
            first, last = int(part[1]), int(part[2]) + 1 if part[2] else last
            headers = {**headers, "Content-Range": f"bytes {first}-{last - 1}/{len(content)}"}
            status = 206
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(last - first))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content[first:last])

    do_GET = do_HEAD = do_POST = do_DELETE = _answer  # noqa: N815  (the server's names)

    def log_message(self, *_): ...
