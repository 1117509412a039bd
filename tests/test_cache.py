"""The cache of decoded steps: equal rows, eviction, torn entries, and memory during decoding."""

import errno
import json
import os
import shutil
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
from tcmrl_data.foundation.errors import CacheError, ManifestError, StoreError
from tcmrl_data.foundation.records import canonical_json, digest, sealed, sha256
from tcmrl_data.sampling import cache
from tcmrl_data.sampling.cache import RECORD_BYTES, cached_rows
from tcmrl_data.sampling.rows import Indices, PartRows, Table, fill_table, read_rows
from tcmrl_data.sampling.sampler import load_rows
from tcmrl_data.store.archive import pack_archive
from tcmrl_data.store.arrays import array_digests, encode_arrays
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part_table import HEADER, PARTS_TABLE, parse_parts, part_line
from tcmrl_data.store.tables import PartKey, seal_of
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
    monkeypatch.setattr("tcmrl_data.sampling.sampler.available_memory", lambda: 2 * size - 2)
    load_rows(selection)
    assert len(entries(folder)) == 1


def test_every_selection_has_an_entry_that_equal_parts_share(
    tiny: Dataset, tiny_copy: Callable[[], Path], folder: Path
) -> None:
    cached_rows(tiny.select(split="train"))
    cached_rows(tiny.select(split="train", snapshots="last"))
    cached_rows(open_dataset(tiny_copy()).select(split="train"))
    assert len(entries(folder)) == 2


@pytest.mark.parametrize("claim", ["part", "root", "nothing"])
def test_a_forged_copy_never_takes_the_place_of_the_honest_dataset(
    tiny: Dataset, tiny_copy: Callable[[], Path], claim: str
) -> None:
    """A copy with other rewards that claims the honest part's id, or the honest root, or to be new data."""
    forged = open_dataset(forge(tiny_copy(), claim=claim)).select
    if claim == "part":
        with pytest.raises(StoreError, match=r"0000150.zip: rewards is not the array that part.json records"):
            cached_rows(forged(tasks=[0]))
    elif claim == "root":
        with pytest.raises(ManifestError, match="do not have the manifest's root"):
            cached_rows(forged(tasks=[0]))
    else:
        cached_rows(forged(tasks=[0]))
    honest = tiny.select(tasks=[0])
    np.testing.assert_array_equal(cached_rows(honest).table, read_rows(honest).table)


def forge(copy: Path, *, claim: str) -> Path:
    """Adds 1 to every reward of a part of a dataset; all digests agree but that of the claim."""
    dataset = open_dataset(copy)
    key = dataset.parts.keys_of(0)[-1]
    with dataset.open_part(key) as archive:
        members = {name: archive.read(name) for name in archive.names}
    rewards = {"rewards": dataset.arrays(*key)["rewards"] + 1}
    members |= {name: data for name, data in encode_arrays(rewards).items() if name.endswith("rewards/c/0")}
    record = json.loads(members["part.json"])
    if claim != "part":
        record["identity"]["arrays"] |= array_digests(rewards)
        record["id"] = digest(record["identity"])
    members["part.json"] = canonical_json(record)
    data = pack_archive(members)
    dataset.file_of(key).write_bytes(data)
    changed = {"id": record["id"], "sha256": sha256(data), "size": len(data)}
    entries = [
        entry._replace(**changed) if (entry.task, entry.step) == key[:2] else entry
        for entry in dataset.parts.entries()
    ]
    lines = HEADER + b"".join(map(part_line, entries))
    (copy / PARTS_TABLE).write_bytes(lines)
    values = json.loads((copy / MANIFEST).read_bytes())
    values["parts"] = seal_of(lines).model_dump()
    values["totals"]["bytes"] = sum(entry.size for entry in entries)
    values["root"] = values["root"] if claim == "root" else parse_parts(lines, copy).root
    values.pop("digest")
    (copy / MANIFEST).write_bytes(sealed(values))
    return copy


@pytest.mark.parametrize("damage", ["cut", "empty", "record", "table", "lengths"])
def test_a_torn_entry_is_made_again(selection: Selection, folder: Path, damage: str) -> None:
    rows = cached_rows(selection)
    expected, lengths = np.array(rows.table), rows.episodes.lengths
    del rows
    (entry,) = entries(folder)
    content = bytearray(entry.read_bytes())
    if damage in ("cut", "empty"):
        entry.write_bytes(content[:-4] if damage == "cut" else b"")
    else:
        content[{"record": 0, "table": RECORD_BYTES, "lengths": -8}[damage]] ^= 1
        entry.write_bytes(content)
    again = cached_rows(selection)
    np.testing.assert_array_equal(again.table, expected)
    np.testing.assert_array_equal(again.episodes.lengths, lengths)


def test_a_copied_cache_is_used(
    selection: Selection, tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached_rows(selection)
    shutil.copytree(folder, tmp_path / "copied")
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "copied"))
    said: list[str] = []
    rows = cached_rows(selection, say=said.append)
    np.testing.assert_array_equal(rows.table, read_rows(selection).table)
    assert said == []


def test_what_is_read_is_never_evicted(selection: Selection, tiny: Dataset, folder: Path) -> None:
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
        os.utime(cache.cache_folder() / "rows" / f"{key}.bin", (1000 + age, 1000 + age))
    cached_rows(old)
    first, second = list_cache()
    monkeypatch.setenv("TCMRL_CACHE_LIMIT", str(first.bytes + second.bytes))
    cached_rows(new)
    left = {entry.key for entry in list_cache()}
    assert len(left) == 2 and first.key not in left and second.key in left


def test_a_disk_without_room_is_refused(selection: Selection, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, first: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(CacheError, match=r"No space left on device.*set TCMRL_CACHE to a folder"):
        cached_rows(selection)


def test_a_damaged_part_leaves_no_entry(tiny_copy: Callable[[], Path], folder: Path) -> None:
    dataset = open_dataset(tiny_copy())
    part = dataset.file_of(dataset.parts.keys_of(0)[0])
    with dataset.open_part(dataset.parts.keys_of(0)[0]) as archive:
        chunk = archive.read("arrays/rewards/c/0")
    part.write_bytes(part.read_bytes().replace(chunk, chunk[:-6] + bytes([chunk[-6] ^ 1]) + chunk[-5:]))
    with pytest.raises(StoreError, match=r"rewards/c/0.*repair"):
        cached_rows(dataset.select())
    assert not (folder / "rows").exists() or not entries(folder)
    assert not (folder / ".staging").exists()


def test_decoding_takes_the_memory_of_the_parts_at_work(
    tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table of 40 parts of 1 MB, decoded by one reader."""

    def fill(part: PartRows, out: Table, *, check_digests: bool) -> Indices:
        out[...] = part.first
        return np.array([len(out) - 1])

    monkeypatch.setattr("tcmrl_data.sampling.rows.READERS", 1)
    monkeypatch.setattr("tcmrl_data.sampling.rows.read_part", fill)
    rows = 2**18 // 8
    plan = [PartRows(tiny, PartKey(0, i), 0, rows * i, rows * (i + 1), 1) for i in range(40)]
    tracemalloc.start()
    mapped: Table = np.memmap(tmp_path / "rows", dtype=np.float32, mode="w+", shape=(40 * rows, 8))
    fill_table(mapped, plan, check_digests=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    del mapped
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
    assert (entry["environment"], entry["tasks"], entry["parts"]) == ("point-robot", 4, 12)
    assert entry["dataset"] == str(selection.dataset.folder) and not entry["in_use"]
    assert "point-robot" in call("cache", "list")[1]
    assert json.loads(call("cache", "clear", "--json")[1]) == {"removed": [entry], "kept": []}
    assert not entries(folder)
