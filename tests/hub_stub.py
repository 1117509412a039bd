"""The routes of the Hugging Face Hub that pushing, pulling and downloading a dataset use, kept in memory."""

import base64
import contextlib
import hashlib
import http.server
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote, urlsplit

from tests.remotes import serving

Tree = dict[str, bytes]


@dataclass
class HubStub:
    """One dataset repository.

    Attributes:
        commits: files after every commit, by its id, oldest first.
        tags: id of the commit that a tag names.
        log: method and path of all requests so far.
    """

    repository: str = "owner/name"
    exists: bool = False
    commits: dict[str, Tree] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    lfs: dict[str, bytes] = field(default_factory=dict)
    log: list[tuple[str, str]] = field(default_factory=list)

    @property
    def head(self) -> str:
        return list(self.commits)[-1]

    def commit(self, tree: Tree) -> str:
        oid = hashlib.sha1(f"{len(self.commits)}".encode()).hexdigest()
        self.commits[oid] = tree
        return oid

    def resolve(self, revision: str) -> str | None:
        revision = unquote(revision)
        if revision == "main":
            return self.head if self.commits else None
        return self.tags.get(revision, revision if revision in self.commits else None)

    @contextlib.contextmanager
    def run(self) -> Iterator[str]:
        """Serves; gives the address, for HF_ENDPOINT."""
        stub = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, format: str, *args: object) -> None:
                """Says nothing."""

            def do_GET(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                path = unquote(urlsplit(self.path).path)
                stub.log.append((self.command, path))
                status, answer, headers = stub._answer(self.command, path, body, self.headers["Host"])
                data = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(data)

            do_POST = do_PUT = do_DELETE = do_HEAD = do_GET  # noqa: N815 # http.server's names

        with serving(Handler) as address:
            yield address

    def _answer(self, method: str, path: str, body: bytes, host: str) -> tuple[int, Any, dict[str, str]]:
        api, pages = f"/api/datasets/{self.repository}", f"/datasets/{self.repository}/resolve/"
        if path == "/api/repos/create":
            self.exists = True
            self.commit({".gitattributes": b""})
            return 200, {"url": f"http://{host}/datasets/{self.repository}"}, {}
        if path == "/api/validate-yaml":
            return 200, {"errors": [], "warnings": []}, {}
        if path.startswith("/lfs/"):
            assert hashlib.sha256(body).hexdigest() == path[5:]
            self.lfs[path[5:]] = body
            return 200, {}, {}
        if not self.exists:
            return 404, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"}
        if path.endswith(".git/info/lfs/objects/batch"):
            asked = json.loads(body)["objects"]
            upload = [{"upload": {"href": f"http://{host}/lfs/{one['oid']}"}} for one in asked]
            rows = [
                one | ({} if one["oid"] in self.lfs else {"actions": actions})
                for one, actions in zip(asked, upload, strict=True)
            ]
            return 200, {"transfer": "basic", "objects": rows}, {}
        if path.startswith(pages):
            revision, _, name = path.removeprefix(pages).partition("/")
            return self._file(self.resolve(revision), name)
        if path == api:
            return self._info(self.head)
        verb, _, rest = path.removeprefix(f"{api}/").partition("/")
        if verb == "refs":
            tags = [{"name": n, "ref": f"refs/tags/{n}", "targetCommit": c} for n, c in self.tags.items()]
            return 200, {"branches": [], "converts": [], "tags": tags}, {}
        if verb == "tag" and method == "DELETE":
            del self.tags[rest]
            return 200, {}, {}
        found = self.resolve(rest.partition("/")[0])
        if found is None:
            return 404, {"error": "Revision not found"}, {"X-Error-Code": "RevisionNotFound"}
        if verb == "revision":
            return self._info(found)
        if verb == "tree":
            return 200, [self._row(name, data) for name, data in self.commits[found].items()], {}
        if verb == "preupload":
            files = [one["path"] for one in json.loads(body)["files"]]
            modes = ["lfs" if name.endswith(".zip") else "regular" for name in files]
            rows = [
                {"path": name, "uploadMode": mode, "shouldIgnore": False}
                for name, mode in zip(files, modes, strict=True)
            ]
            return 200, {"files": rows}, {}
        if verb == "tag":
            tag = json.loads(body)["tag"]
            if tag in self.tags:
                return 409, {"error": "Tag exists"}, {}
            self.tags[tag] = found
            return 200, {}, {}
        assert verb == "commit", path
        return self._take(body, found)

    def _take(self, body: bytes, head: str) -> tuple[int, Any, dict[str, str]]:
        lines = [json.loads(line) for line in body.splitlines()]
        if lines[0]["value"].get("parentCommit", head) != head:
            return 412, {"error": "A commit has happened since. Please refresh and try again."}, {}
        tree = dict(self.commits[head])
        for line in lines[1:]:
            value = line["value"]
            is_large = line["key"] == "lfsFile"
            tree[value["path"]] = self.lfs[value["oid"]] if is_large else base64.b64decode(value["content"])
        oid = self.commit(tree)
        return (
            200,
            {
                "commitUrl": f"https://huggingface.co/datasets/{self.repository}/commit/{oid}",
                "commitOid": oid,
            },
            {},
        )

    def _info(self, oid: str) -> tuple[int, Any, dict[str, str]]:
        siblings = [{"rfilename": name} for name in self.commits[oid]]
        return 200, {"id": self.repository, "sha": oid, "siblings": siblings, "tags": []}, {}

    def _row(self, name: str, data: bytes) -> dict[str, Any]:
        blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        row: dict[str, Any] = {"type": "file", "path": name, "size": len(data), "oid": blob}
        if name.endswith(".zip"):
            sha = hashlib.sha256(data).hexdigest()
            row["lfs"] = {"oid": sha, "size": len(data), "pointerSize": 130}
        return row

    def _file(self, oid: str | None, name: str) -> tuple[int, Any, dict[str, str]]:
        data = self.commits[oid].get(name) if oid else None
        if oid is None or data is None:
            code = "EntryNotFound" if oid else "RevisionNotFound"
            return 404, {"error": "not found"}, {"X-Error-Code": code}
        return 200, data, {"X-Repo-Commit": oid, "ETag": f'"{hashlib.sha256(data).hexdigest()}"'}
