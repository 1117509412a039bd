"""The cache of decoded steps: equal rows, eviction, torn entries, and memory during decoding."""

import json
import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.data import data

from tcmrl_data import (
    BatchRequest,
    Dataset,
    Selection,
    Trajectories,
    Transitions,
    Windows,
    clear_cache,
    list_cache,
    open_dataset,
    open_sampler,
    parse_bytes,
)
from tcmrl_data.foundation.errors import CacheError, StoreError
from tcmrl_data.sampling import cache
from tcmrl_data.sampling.cache import cached_rows, load_rows
from tcmrl_data.sampling.cache_entry import _write_rows
from tcmrl_data.sampling.rows import Indices, PartRows, Table, read_rows
from tests.commands import Call, in_process

REQUEST = BatchRequest(
    tasks=16, kinds={"policy": Transitions(20), "context": Trajectories(1), "windows": Windows(5, length=3)}
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Every test has a separate cache."""
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def selection(tiny: Dataset) -> Selection:
    return tiny.select(split="train")


def entries(folder: Path) -> list[Path]:
    return sorted((folder / "rows").iterdir())


def test_the_cache_holds_the_rows_that_memory_holds(selection: Selection) -> None:
    expected = read_rows(selection)
    for rows in (cached_rows(selection), cached_rows(selection)):  # decoded, then found
        np.testing.assert_array_equal(rows.table, expected.table)
        for name in ("starts", "lengths", "task_ranges"):
            np.testing.assert_array_equal(getattr(rows.episodes, name), getattr(expected.episodes, name))
        assert rows.task_indices.tolist() == expected.task_indices.tolist()


def test_batches_are_the_same_from_the_cache(selection: Selection) -> None:
    said: list[str] = []
    left = open_sampler(selection, REQUEST, seed=1).batch(7)
    right = open_sampler(selection, REQUEST, seed=1, memory_limit=1000, say=said.append).batch(7)
    assert left["windows"].observations.equal(right["windows"].observations)
    assert left["context"].rewards.equal(right["context"].rewards)
    assert "exceed the memory limit" in said[0] and "happens once" in said[1]


def test_the_limit_decides(selection: Selection, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = read_rows(selection).table.nbytes
    load_rows(selection, memory_limit=size)
    assert not folder.exists()
    monkeypatch.setattr(cache, "available_memory", lambda: 2 * size - 2)
    load_rows(selection)
    assert len(entries(folder)) == 1


def test_the_key_is_the_selection_and_the_root(tiny: Dataset, folder: Path) -> None:
    cached_rows(tiny.select(split="train"))
    cached_rows(tiny.select(split="train", snapshots="last"))
    other = Dataset(tiny.folder, tiny.manifest.model_copy(update={"root": "0" * 64}))
    cached_rows(other.select(split="train"))
    assert len(entries(folder)) == 3


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        *(
            (file, damage)
            for file in ("record.json", "episodes.i64")
            for damage in ("cut", "missing", "flipped")
        ),
        ("rows.f32", "cut"),
        ("rows.f32", "missing"),
    ],
)
def test_a_torn_entry_is_made_again(selection: Selection, folder: Path, file: str, damage: str) -> None:
    expected = np.array(cached_rows(selection).table)
    (entry,) = entries(folder)
    content = (entry / file).read_bytes()
    if damage == "missing":
        (entry / file).unlink()
    else:
        flipped = content[:-9] + bytes([content[-9] ^ 1]) + content[-8:]
        (entry / file).write_bytes(content[:-4] if damage == "cut" else flipped)
    np.testing.assert_array_equal(cached_rows(selection).table, expected)
    assert (entries(folder)[0] / file).read_bytes() == content


def test_what_is_read_is_never_evicted(
    selection: Selection, tiny: Dataset, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TCMRL_CACHE_LIMIT", "1k")
    sampler = open_sampler(selection, REQUEST, seed=0, memory_limit=1)
    expected = open_sampler(selection, REQUEST, seed=0).batch(3)
    cached_rows(tiny.select(split="train", snapshots="last"))
    assert [entry.in_use for entry in list_cache()] == [True, False]
    assert len(clear_cache()) == 1
    assert sampler.batch(3)["context"].rewards.equal(expected["context"].rewards)
    del sampler
    assert [entry.in_use for entry in list_cache()] == [False]
    assert len(clear_cache()) == 1 and not entries(folder)


def test_another_process_keeps_its_entry_too(selection: Selection, tiny_folder: Path, folder: Path) -> None:
    code = (
        "import sys, tcmrl_data; from tcmrl_data.sampling.cache import cached_rows\n"
        f"rows = cached_rows(tcmrl_data.open_dataset({str(tiny_folder)!r}).select(split='train'))\n"
        "print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as reader:
        assert reader.stdout is not None and reader.stdout.readline() == "ready\n"
        assert clear_cache() == ()
        reader.communicate()
    assert len(clear_cache()) == 1


def test_what_was_used_longest_ago_goes_first(tiny: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three entries of one size where two have room; the older one of the first two was used again."""
    old, older, new = (tiny.select(tasks=[0, other]) for other in (40, 60, 99))
    for age, selection in enumerate((old, older)):
        cached_rows(selection)
        key = next(entry.key for entry in list_cache() if entry.used > 2000)
        os.utime(cache.cache_folder() / "rows" / key / "record.json", (1000 + age, 1000 + age))
    cached_rows(old)
    first, second = list_cache()
    monkeypatch.setenv("TCMRL_CACHE_LIMIT", str(first.bytes + second.bytes))
    cached_rows(new)
    left = {entry.key for entry in list_cache()}
    assert len(left) == 2 and first.key not in left and second.key in left


def test_a_disk_without_room_is_refused(selection: Selection, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr("tcmrl_data.sampling.cache.shutil.disk_usage", lambda path: usage)
    with pytest.raises(CacheError, match="TCMRL_CACHE"):
        cached_rows(selection)


def test_a_damaged_part_leaves_no_entry(tiny_copy: Callable[[], Path], folder: Path) -> None:
    dataset = open_dataset(tiny_copy())
    chunk = next(dataset.folder.glob("tasks/*/snapshots/*/rewards/c/0"))
    content = bytearray(chunk.read_bytes())
    content[-6] ^= 1
    chunk.write_bytes(bytes(content))
    with pytest.raises(StoreError, match=r"rewards/c/0 does not decode.*repair"):
        cached_rows(dataset.select())
    assert not (folder / "rows").exists() or not entries(folder)
    assert not [path for path in (folder / ".staging").iterdir() if path.suffix != ".lock"]


def test_decoding_takes_the_memory_of_the_parts_at_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table of 40 parts of 1 MB, decoded by one reader."""

    def fill(part: PartRows, out: Table) -> Indices:
        out[...] = part.first
        return np.array([len(out) - 1])

    monkeypatch.setattr("tcmrl_data.sampling.rows.READERS", 1)
    monkeypatch.setattr("tcmrl_data.sampling.cache_entry.read_part", fill)
    rows = 2**18 // 8
    plan = [PartRows(tmp_path, 0, rows * i, rows * (i + 1)) for i in range(40)]
    tracemalloc.start()
    _write_rows(tmp_path / "rows", plan, (40 * rows, 8))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * 2**20
    table = np.fromfile(tmp_path / "rows", dtype=np.float32).reshape(40, -1)
    assert (table == np.arange(40)[:, None] * rows).all()


@pytest.mark.parametrize(
    ("text", "expected"), [("2G", 2 * 10**9), ("500M", 5 * 10**8), ("1.5 kB", 1500), ("1K", 1000)]
)
def test_sizes_are_read_in_decimal_units(text: str, expected: int) -> None:
    assert parse_bytes(text) == expected


@pytest.mark.parametrize("text", ["", "0", "0.1", "-1G", "2 X", "many"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(CacheError, match="is no size; write a number above 0 and one of B, k, M, G, T"):
        parse_bytes(text)


def test_list_and_clear_commands(
    selection: Selection, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call: Call = in_process(data, capsys)
    assert call("cache", "list")[0] == 0
    cached_rows(selection)
    document = json.loads(call("cache", "list", "--json")[1])
    assert document["folder"] == str(folder) and document["limit"] == 100 * 10**9
    (entry,) = document["entries"]
    assert (entry["environment"], entry["tasks"], entry["in_use"]) == ("point-robot", 4, False)
    assert "point-robot" in call("cache", "list")[1]
    assert json.loads(call("cache", "clear", "--json")[1]) == {"removed": [entry], "kept": []}
    assert not entries(folder)
