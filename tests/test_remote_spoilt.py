"""Each object of a push and of a pull is spoilt in turn, once and for good: done all the same, or named."""

# ruff: noqa: F811 # fixtures of another file
import itertools
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("obstore", reason="needs the extra `remote`")
pytest.importorskip("moto", reason="needs the extra `test`")

from tcmrl_data import TcmrlError, open_dataset, pull_dataset, push_dataset
from tcmrl_data.store.manifest import MANIFEST
from tests.remotes import (  # noqa: F401 # fixtures
    FLAWS,
    Proxy,
    bucket,
    frozen,
    own_fetched_parts,
    sealed_files,
    server,
)

STRIDE = 17
"""Every so many cases are tried but in sweeps; prime to their number, so that flaws try different objects."""

Request = tuple[str, str]
"""Method, and file relative to the dataset's address."""


@pytest.fixture(scope="module")
def counts() -> Iterator[Counter[str]]:
    """How spoilt commands ended; printed at the end (`pytest -s`)."""
    counts: Counter[str] = Counter()
    yield counts
    ends = ", ".join(f"{how} {number}" for how, number in sorted(counts.items()))
    print(f"\n{counts.total()} spoilt: {ends}")  # noqa: T201


def requests_of(server: Proxy) -> list[Request]:
    """The different requests so far."""
    return sorted({(method, object_of(path)) for method, path in server.log})


def object_of(path: str) -> str:
    """The file that a request is about, or `parts`, which is listed."""
    path, _, query = path.partition("?")
    return "parts" if "list-type" in query else path.split("/", 3)[-1]


def spoil(server: Proxy, flaw: str, request: Request, *, always: bool) -> None:
    """Spoils the first request of its kind, or all of them."""
    numbers = itertools.count()

    def choose(number: int, method: str, path: str) -> str | None:
        if (method, object_of(path)) != request or (next(numbers) and not always):
            return None
        return flaw

    server.reset(choose)


def outcome(server: Proxy, request: Request, error: TcmrlError | None) -> str:
    """How a command ended; an error names the object, or the tag that led to it."""
    number = [(method, object_of(path)) for method, path in server.log].count(request)
    server.reset()
    assert number > 0
    if error is None:
        return "retried" if number > 1 else "harmless"
    assert request[1] in str(error) or "@v1" in str(error), (request, error)
    return "named"


@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.check
def test_a_spoilt_object_is_retried_or_named(
    bucket: str, server: Proxy, frozen: Path, tmp_path: Path, flaw: str, sweep: int, counts: Counter[str]
) -> None:
    push_dataset(frozen, bucket, tag="v1")
    pushes, root = requests_of(server), open_dataset(frozen).manifest.root
    server.reset()
    pull_dataset(f"{bucket}@v1", tmp_path / "straight")
    cases = [("push", request, always) for request in pushes for always in (False, True)]
    cases += [("pull", request, always) for request in requests_of(server) for always in (False, True)]
    step = 1 if sweep == 1 else STRIDE
    for number in range(FLAWS.index(flaw) % step, len(cases), step):
        verb, request, always = cases[number]
        place, out, error = f"{bucket}-{number}", tmp_path / f"out-{number}", None
        shutil.rmtree(os.environ["TCMRL_CACHE"], ignore_errors=True)
        spoil(server, flaw, request, always=always)
        try:
            if verb == "push":
                push_dataset(frozen, place, tag="v1")
            else:
                pull_dataset(f"{bucket}@v1", out)
        except TcmrlError as raised:
            error = raised
        how = outcome(server, request, error)
        counts[f"{flaw} {how}"] += 1
        if flaw in ("drop", "throttle", "unavailable"):
            assert how == ("named" if always else "retried"), (verb, request, error)
        if verb == "push":
            if error:
                push_dataset(frozen, place, tag="v1")
            opened = open_dataset(f"{place}@v1")
            opened.fetch()
            assert opened.manifest.root == root
            continue
        # a swapped answer may be longer, which is not asked for again, or equal
        if request[1].endswith(".zip") and flaw not in ("delay", "swap"):
            assert how == ("named" if always else "retried"), (verb, request, error)
        if error:
            assert not (out / MANIFEST).exists()
            for file in out.rglob("*.zip"):
                assert file.read_bytes() == (frozen / file.relative_to(out)).read_bytes()
            pull_dataset(f"{bucket}@v1", out)
        assert sealed_files(out) == sealed_files(frozen)
