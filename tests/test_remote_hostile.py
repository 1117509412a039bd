"""A hostile server gets a typed error: nothing is written outside or kept, and memory is bounded."""

import contextlib
import functools
import gzip
import itertools
import json
import resource
import shutil
import time
import tracemalloc
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytest.importorskip("obstore", reason="needs the extra `remote`")

from tcmrl_data import TcmrlError, open_dataset, pull_dataset
from tcmrl_data.dataset.listing import list_datasets
from tcmrl_data.foundation.machine import resident_memory
from tcmrl_data.foundation.records import canonical_json, sealed, sha256
from tcmrl_data.remote import objects
from tcmrl_data.remote.address import parse_address
from tcmrl_data.remote.objects import LISTED_BYTES, Objects, OversizeError
from tcmrl_data.store.manifest import MANIFEST
from tests.remotes import FROZEN, serving

MEMORY = 64 * 2**20
"""A case may take so many bytes of Python's memory at its peak."""

FIRST = "parts/main/00000/0000000.zip"
Answer = Callable[[BaseHTTPRequestHandler], None]
Files = dict[str, bytes | Answer]
CASES: dict[str, Callable[[Files], None]] = {}


def case(change: Callable[[Files], None]) -> Callable[[Files], None]:
    """Registers a change of a sound dataset's files."""
    CASES[change.__name__] = change
    return change


def _send(handler: BaseHTTPRequestHandler, body: Iterator[bytes], **headers: str) -> None:
    handler.send_response(200)
    for name, value in headers.items():
        handler.send_header(name.replace("_", "-"), value)
    handler.end_headers()
    handler.close_connection = True
    with contextlib.suppress(OSError):  # the other side has heard enough
        for piece in body:
            handler.wfile.write(piece)


def endless(handler: BaseHTTPRequestHandler) -> None:
    """Zeros without end, and without a length."""
    _send(handler, itertools.repeat(bytes(2**16)))


def lengthy(handler: BaseHTTPRequestHandler) -> None:
    """Claims a terabyte and sends zeros."""
    _send(handler, itertools.repeat(bytes(2**16)), Content_Length=str(2**40))


@functools.cache
def packed_zeros() -> bytes:
    """64 MiB of zeros in 64 kB."""
    return gzip.compress(bytes(2**26))


def bomb(handler: BaseHTTPRequestHandler) -> None:
    """64 MiB of zeros, packed to 64 kB; 64 times."""
    _send(handler, itertools.repeat(packed_zeros(), 64), Content_Encoding="gzip")


def forged(files: Files, **changes: Any) -> None:
    """Changes fields of the manifest, and seals it again."""
    fields = json.loads(_bytes(files, MANIFEST))
    del fields["digest"]
    files[MANIFEST] = sealed(fields | changes)


def with_part(files: Files, **changes: Any) -> None:
    """Changes the first part's line, and seals table and manifest again."""
    head, first, *rest = _bytes(files, "parts.jsonl").splitlines(keepends=True)
    names = json.loads(head)
    line = dict(zip(names, json.loads(first), strict=True)) | changes
    table = head + canonical_json([line[name] for name in names]) + b"".join(rest)
    files["parts.jsonl"] = table
    seal = {"lines": table.count(b"\n"), "bytes": len(table), "sha256": sha256(table)}
    forged(files, parts=seal)


def _bytes(files: Files, name: str) -> bytes:
    data = files[name]
    assert isinstance(data, bytes)
    return data


@case
def manifest_without_end(files: Files) -> None:
    files[MANIFEST] = endless


@case
def manifest_of_a_terabyte(files: Files) -> None:
    files[MANIFEST] = lengthy


@case
def manifest_that_is_a_bomb(files: Files) -> None:
    files[MANIFEST] = bomb


@case
def manifest_that_is_no_json(files: Files) -> None:
    files[MANIFEST] = b"<html>"


@case
def manifest_that_is_deep(files: Files) -> None:
    files[MANIFEST] = b"[" * 100_000


@case
def manifest_that_was_edited(files: Files) -> None:
    files[MANIFEST] = _bytes(files, MANIFEST).replace(b'"complete":true', b'"complete":false')


@case
def manifest_that_colours_the_terminal(files: Files) -> None:
    forged(files, label="\x1b[31m")


@case
def manifest_with_a_huge_table(files: Files) -> None:
    seal = json.loads(_bytes(files, MANIFEST))["parts"]
    forged(files, parts=seal | {"bytes": 2**39})
    files["parts.jsonl"] = endless


@case
def table_without_end(files: Files) -> None:
    files["tasks.jsonl"] = endless


@case
def table_cut_short(files: Files) -> None:
    files["parts.jsonl"] = _bytes(files, "parts.jsonl")[:-10]


@case
def table_with_a_path_as_a_run(files: Files) -> None:
    with_part(files, run="../../../escaped")


@case
def table_with_a_negative_task(files: Files) -> None:
    with_part(files, task=-1)


@case
def table_with_a_huge_part(files: Files) -> None:
    with_part(files, size=2**39)
    files[FIRST] = endless


@case
def table_that_names_another_part(files: Files) -> None:
    other = json.loads(_bytes(files, "parts.jsonl").splitlines()[2])
    names = json.loads(_bytes(files, "parts.jsonl").splitlines()[0])
    found = dict(zip(names, other, strict=True))
    with_part(files, sha256=found["sha256"], size=found["size"])
    files[FIRST] = _bytes(files, f"parts/main/{found['task']:05d}/{found['step']:07d}.zip")


@case
def part_without_end(files: Files) -> None:
    files[FIRST] = endless


@case
def part_of_a_terabyte(files: Files) -> None:
    files[FIRST] = lengthy


@case
def part_that_is_a_bomb(files: Files) -> None:
    files[FIRST] = bomb


@case
def part_cut_short(files: Files) -> None:
    files[FIRST] = _bytes(files, FIRST)[:-1]


@case
def part_with_other_bytes(files: Files) -> None:
    files[FIRST] = _bytes(files, FIRST)[::-1]


@case
def part_that_is_missing(files: Files) -> None:
    del files[FIRST]


@case
def part_that_leads_to_a_file_of_this_disk(files: Files) -> None:
    def redirect(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(302)
        handler.send_header("Location", "file:///etc/passwd")
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    files[FIRST] = redirect


@case
def part_that_leads_in_circles(files: Files) -> None:
    def redirect(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(302)
        handler.send_header("Location", handler.path)
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    files[FIRST] = redirect


@case
def part_that_drips(files: Files) -> None:
    def drip(handler: BaseHTTPRequestHandler) -> None:
        _send(handler, (bytes(1) for _ in iter(lambda: objects.time.sleep(0.02), 0)), Content_Length="9000")

    files[FIRST] = drip


@pytest.fixture(autouse=True)
def own_fetched_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "inside" / "cache"))
    monkeypatch.setattr(objects, "PAUSES", (0.01,) * 2)
    monkeypatch.setattr(objects, "PATIENCE", 0.3)


@contextlib.contextmanager
def hostile(files: Files) -> Iterator[str]:
    """Serves some files, or whatever a function answers."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

        def do_GET(self) -> None:
            found = files.get(urlsplit(self.path).path.removeprefix("/dataset/"))
            if callable(found):
                found(self)
                return
            body = found if isinstance(found, bytes) else b""
            self.send_response(404 if found is None else 200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_HEAD = do_GET  # noqa: N815 # http.server's name

    with serving(Handler) as address:
        yield f"{address}/dataset"


def sound_files() -> Files:
    """The files of a sound dataset."""
    return {
        str(path.relative_to(FROZEN)): path.read_bytes()
        for path in sorted(FROZEN.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("change", CASES.values(), ids=CASES)
def test_a_hostile_server_gets_an_error(change: Callable[[Files], None], tmp_path: Path) -> None:
    files = sound_files()
    change(files)
    packed_zeros()  # before memory is measured
    inside, limit = tmp_path / "inside", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**28, limit[1]))  # whoever writes more is killed
    tracemalloc.start()
    try:
        with hostile(files) as address:
            with pytest.raises(TcmrlError) as raised:
                open_dataset(address).part(0, 0)
            assert "\n" not in str(raised.value) and str(raised.value).isprintable()
            if change is not table_that_names_another_part:  # whose bytes are those that its table seals
                with pytest.raises(TcmrlError):
                    pull_dataset(address, inside / "out")
                assert not (inside / "out" / MANIFEST).exists()
                assert not (inside / "out" / FIRST).exists()
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert {path.name for path in tmp_path.iterdir()} <= {"inside"}
    kept = [path for path in (inside / "cache").rglob("*.zip") if sha256(path.read_bytes()) != path.stem]
    assert kept == []


def test_there_are_twenty_cases() -> None:
    assert len(CASES) >= 20


def test_a_tag_that_names_another_manifest_is_refused(tmp_path: Path) -> None:
    files = sound_files()
    manifest = json.loads(_bytes(files, MANIFEST))
    ref = {"schema_version": 1, "root": manifest["root"], "digest": "0" * 64, "time": "2026-01-01T00:00:00"}
    files["refs/v1.json"] = json.dumps(ref).encode()
    files[f"versions/{'0' * 32}/{MANIFEST}"] = files[MANIFEST]
    with hostile(files) as address, pytest.raises(TcmrlError, match="the tag names root"):
        open_dataset(f"{address}@v1")
    files["refs/v1.json"] = json.dumps(ref | {"digest": manifest["digest"]}).encode()
    for name in (MANIFEST, "tasks.jsonl", "parts.jsonl"):
        files[f"versions/{manifest['digest'][:32]}/{name}"] = files[name]
    with hostile(files) as address:
        assert open_dataset(f"{address}@v1").manifest.digest == manifest["digest"]


LISTING = """<?xml version="1.0" encoding="UTF-8"?>
<ListBucketResult xmlns="http://s3.amazonaws.com/doc/2006-03-01/"><Name>bucket</Name>{}
</ListBucketResult>"""
MORE = "<IsTruncated>true</IsTruncated><NextContinuationToken>{}</NextContinuationToken>"
FILE = """<Contents><Key>parts/{}</Key><LastModified>2026-01-01T00:00:00.000Z</LastModified>
<ETag>"0"</ETag><Size>1</Size></Contents>"""
Page = Callable[[int], Iterator[bytes]]


@contextlib.contextmanager
def hostile_bucket(page: Page) -> Iterator[Objects]:
    """A bucket whose server answers a request by the page of its number."""
    numbers = itertools.count()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

        def do_GET(self) -> None:
            _send(self, page(next(numbers)))

    with serving(Handler) as address, pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", "key")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_ENDPOINT_URL", address)
        yield Objects(parse_address("s3://bucket"))


def test_names_in_a_listing_lead_nowhere(tmp_path: Path) -> None:
    names = ("../", "a/../../", "\u202ebackwards/", "x@y@z/", "%2e%2e/")
    prefixes = "".join(f"<CommonPrefixes><Prefix>{name}</Prefix></CommonPrefixes>" for name in names)
    page = LISTING.format(f"<IsTruncated>false</IsTruncated>{prefixes}").encode()
    with hostile_bucket(lambda number: iter([page])), contextlib.suppress(TcmrlError):
        assert list_datasets("s3://bucket") == []
    assert list(tmp_path.iterdir()) == []


def test_folders_without_end_are_refused() -> None:
    folders = "".join(f"<CommonPrefixes><Prefix>{n}/</Prefix></CommonPrefixes>" for n in range(1_001))
    page = LISTING.format(f"<IsTruncated>false</IsTruncated>{folders}").encode()
    with (
        hostile_bucket(lambda number: iter([page])),
        pytest.raises(TcmrlError, match="more than 1,000 folders"),
    ):
        list_datasets("s3://bucket")


def files_without_end(number: int) -> Iterator[bytes]:
    yield LISTING.format(MORE.format(number) + FILE.format(number)).encode()


def one_file_without_end(number: int) -> Iterator[bytes]:
    yield LISTING.format(MORE.format(number) + FILE.format(0)).encode()


def empty_pages_without_end(number: int) -> Iterator[bytes]:
    yield LISTING.format(MORE.format(number)).encode()


def page_without_end(number: int) -> Iterator[bytes]:
    yield LISTING.partition("{}")[0].encode()
    yield from itertools.repeat(b" " * 2**16)


@pytest.mark.parametrize(
    "page", [files_without_end, one_file_without_end, empty_pages_without_end, page_without_end]
)
def test_a_listing_without_end_is_refused(monkeypatch: pytest.MonkeyPatch, page: Page) -> None:
    with hostile_bucket(page) as bucket:
        for look in (bucket.listing, bucket.folder):
            before, began = resident_memory(), time.monotonic()
            with pytest.raises(OversizeError, match="has a listing that does not end"):
                look()
            assert resident_memory() - before < LISTED_BYTES + MEMORY
            assert time.monotonic() - began < 10  # PATIENCE is 0.3


def test_a_listing_takes_no_more_memory_than_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "PATIENCE", 60)
    monkeypatch.setattr(objects, "LISTED_BYTES", 2**25)
    with hostile_bucket(page_without_end) as bucket:
        before = resident_memory()
        with pytest.raises(OversizeError, match=r"does not end within 60 s and 33\.6 MB"):
            bucket.folder()
        assert resident_memory() - before < 2**25 + MEMORY


@pytest.mark.parametrize("page", [files_without_end, one_file_without_end])
def test_a_listing_names_no_more_files_than_a_dataset_may_have(
    monkeypatch: pytest.MonkeyPatch, page: Page
) -> None:
    monkeypatch.setattr(objects, "PATIENCE", 60)
    monkeypatch.setattr(objects, "LISTED", 10)
    monkeypatch.setattr(objects, "MOST_FILES", 100)
    with hostile_bucket(page) as bucket, pytest.raises(OversizeError, match="has more than 100 files"):
        bucket.listing()


def test_a_sound_server_is_read(tmp_path: Path) -> None:
    with hostile(sound_files()) as address:
        assert pull_dataset(address, tmp_path / "out").parts == 9
    shutil.rmtree(tmp_path / "out")
