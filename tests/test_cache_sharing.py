"""The cache in several processes: one decodes while others wait, and the limit is a cap."""

import contextlib
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tcmrl_data import Dataset, Selection, list_cache
from tcmrl_data.foundation import disk
from tcmrl_data.foundation.disk import lock_file, lock_holder
from tcmrl_data.foundation.errors import CacheError, LockedError
from tcmrl_data.foundation.files import try_exclusive_lock
from tcmrl_data.sampling.cache import cached_rows, entry_bytes
from tcmrl_data.sampling.rows import read_rows
from tests.disks import read_only, run_mounted

READER = r"""
import sys, tcmrl_data
from tcmrl_data.sampling import rows as packed
from tcmrl_data.sampling.cache import cached_rows
read_part = packed.read_part

def read_after_a_line(*arguments, **options):
    print("reading\n", end="", flush=True)  # several threads do so
    sys.stdin.readline()
    return read_part(*arguments, **options)

if sys.argv[2] == "slow":
    packed.read_part = read_after_a_line
selection = tcmrl_data.open_dataset(sys.argv[1]).select(split="train")
rows = cached_rows(selection, say=lambda text: print(text, flush=True))
print("sum", rows.table.sum(dtype=float), flush=True)
"""
"""Opens the cached rows; a slow process reads each part only after a line, or the end, of standard input."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Every test has a separate cache."""
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def selection(tiny: Dataset) -> Selection:
    return tiny.select(split="train")


@contextlib.contextmanager
def reader(dataset: Path, speed: str = "fast") -> Iterator["subprocess.Popen[str]"]:
    """A process that opens the cached rows of a dataset's training tasks."""
    command = [sys.executable, "-c", READER, str(dataset), speed]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@pytest.mark.check
def test_one_process_decodes_while_the_others_wait(
    selection: Selection, tiny_folder: Path, folder: Path
) -> None:
    with reader(tiny_folder, "slow") as first:
        assert line(first).startswith("decoding ") and line(first) == "reading"
        with reader(tiny_folder) as second, reader(tiny_folder) as third:
            for waiting in (second, third):
                said = line(waiting)
                assert f"is being written by process {first.pid} on " in said and "waiting" in said
            assert list_cache() == ()
            rest = first.communicate()[0].splitlines()
            sums = {rest[-1], line(second), line(third)}
    assert sums == {f"sum {read_rows(selection).table.sum(dtype=float)}"}
    assert len(list_cache()) == 1 and not (folder / ".staging").exists()


def test_who_waits_takes_over_from_a_killed_process(selection: Selection, tiny_folder: Path) -> None:
    said: list[str] = []
    with reader(tiny_folder, "slow") as decoder:
        assert line(decoder).startswith("decoding ") and line(decoder) == "reading"

        def say(message: str) -> None:
            said.append(message)
            decoder.kill()

        rows = cached_rows(selection, say=say)
    np.testing.assert_array_equal(rows.table, read_rows(selection).table)
    assert [message.partition(" ")[0] for message in said][-1] == "decoding"
    assert "waiting for it" in said[0] and len(said) == 2


def test_one_entry_is_written_at_a_time(tiny: Dataset, tiny_folder: Path) -> None:
    """Who decodes another selection waits too; what a killed process left takes no room."""
    other, said = tiny.select(split="train", snapshots="last"), list[str]()
    with reader(tiny_folder, "slow") as decoder:
        assert line(decoder).startswith("decoding ") and line(decoder) == "reading"

        def say(message: str) -> None:
            said.append(message)
            decoder.kill()

        rows = cached_rows(other, say=say)
    np.testing.assert_array_equal(rows.table, read_rows(other).table)
    assert "waiting for it" in said[0]
    (entry,) = list_cache()
    assert entry.bytes <= entry_bytes(other)


def test_the_limit_is_a_cap(tiny: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """A larger entry is refused before anything is evicted, and so is one beside entries that are in use."""
    small, large = tiny.select(tasks=[0]), tiny.select(split="train")
    monkeypatch.setenv("TCMRL_CACHE_LIMIT", str(entry_bytes(large) - 1))
    cached_rows(small)
    with pytest.raises(CacheError, match=r" 0 B are in use, .*raise TCMRL_CACHE_LIMIT or --memory-limit"):
        cached_rows(large)
    rows = cached_rows(small, say=lambda message: pytest.fail("evicted"))
    monkeypatch.setenv("TCMRL_CACHE_LIMIT", str(entry_bytes(large)))
    with pytest.raises(CacheError, match=r" [1-9][\d.]* kB are in use"):
        cached_rows(large)
    assert len(list_cache()) == 1
    del rows
    cached_rows(large)
    (entry,) = list_cache()
    assert 0.5 * entry_bytes(large) < entry.bytes <= entry_bytes(large)


def test_a_removed_lock_is_not_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its holder removes the file after another process opened it: the lock then is the new file's."""

    def remove_once(file: Any) -> bool:
        monkeypatch.setattr(disk, "try_exclusive_lock", try_exclusive_lock)
        (tmp_path / "lock").unlink()
        return try_exclusive_lock(file)

    monkeypatch.setattr(disk, "try_exclusive_lock", remove_once)
    with lock_file(tmp_path / "lock", "it") as lock:
        assert lock_holder(lock) is not None


def test_a_lock_that_its_holder_removes_is_refused_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def remove_and_refuse(file: Any) -> bool:
        (tmp_path / "lock").unlink()
        return False

    monkeypatch.setattr(disk, "try_exclusive_lock", remove_and_refuse)
    with pytest.raises(LockedError, match="by another process"), lock_file(tmp_path / "lock", "it"):
        pass


def test_a_cache_that_may_only_be_read_is_read(selection: Selection, tiny_folder: Path, folder: Path) -> None:
    cached_rows(selection)
    code = f"{READER}\nfor _ in range(2): print(tcmrl_data.list_cache()[0].in_use); rows = None"
    look = shlex.join([sys.executable, "-c", code, str(tiny_folder), "fast"])
    result = run_mounted(read_only(folder), "cache", "clear", then=look)
    assert "Read-only file system" in result.stderr and result.stderr.count("\n") == 1, result.stderr
    total = read_rows(selection).table.sum(dtype=float)
    assert result.stdout.splitlines() == [f"sum {total}", "True", "False"]
