"""One entry of the cache: packed rows as files that are mapped into memory.

`rows.f32` is the table. `episodes.i64` holds starts, lengths and task ranges. `blocks.bin` holds the sha256
of every part's rows in the table. `record.json` holds the digest of the record in its first line, then the
record, with the digests of the two small files and the seal of the table. An entry is forced to disk,
published by one rename, and never changes. A reader holds a shared lock on its record.

What opening an entry checks: the small files by digest, and that the table is still the file that was sealed:
size, inode, and the time of its last change, which a program cannot set back. So a table that was cut, edited
or replaced is found at once. A table of up to CHECKED_BYTES is hashed as well, and so is every table that is
not the sealed file (a copied cache). What opening does not find is damage below the file system in a larger
table; `tcmrl-data cache verify` hashes every table and finds it. Nothing here guards against a person who may
write to the cache's folder and forges a whole entry: give write access only to those who are trusted.
"""

import contextlib
import os
import weakref
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from tcmrl_data.foundation.canonical import canonical_json, digest, sha256
from tcmrl_data.foundation.disk import disk, is_current, named_errors, write_file
from tcmrl_data.foundation.locks import take_shared_lock
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.sampling.cache_table import BLOCK, Blocks, TableSeal, table_problem, write_table
from tcmrl_data.sampling.rows import (
    Episodes,
    PackedRows,
    Table,
    plan_rows,
    row_arrays,
    selection_rows,
    table_shape,
)

if TYPE_CHECKING:
    from tcmrl_data.dataset.selection import Selection

FORMAT = 2
"""Increased when the layout of an entry changes; entries of another format are not opened."""

CHECKED_BYTES = 10**9
"""A table up to this size is hashed whenever it is opened, which takes about a second on one core."""

RECORD_BYTES = 2**15
"""More than a record takes."""

RECORD = "record.json"
ROWS = "rows.f32"
EPISODES = "episodes.i64"
BLOCKS = "blocks.bin"


class EntryRecord(BaseModel):
    """Description of an entry.

    Attributes:
        format: FORMAT of the version that wrote the entry.
        key: name of its folder.
        environment: name of the dataset's environment.
        dataset: folder of the dataset that it was decoded from; equal parts elsewhere share the entry.
        tasks: number of selected tasks.
        parts: number of selected parts.
        shape: (rows, floats per row) of the table.
        episodes: number of episodes with at least one step.
        episodes_sha256: digest of the file of episodes.
        blocks_sha256: digest of the file of blocks.
        seal: the finished table.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int
    key: str
    environment: str
    dataset: str
    tasks: int
    parts: int
    shape: tuple[int, int]
    episodes: int
    episodes_sha256: str
    blocks_sha256: str
    seal: TableSeal


def entry_key(selection: "Selection", *, dense: bool = False) -> str:
    """The name of a selection's entry: a digest of what its rows hold, whatever the dataset claims.

    A part's id is the digest of its identity, which holds the sha256 of every decoded array. Decoding checks
    both, so that an entry holds what its key says.
    """
    dataset = selection.dataset
    parts = [
        (key.task, key.step, dataset.entry(key).id)
        for task in selection.tasks
        for key in selection.parts[task.index]
    ]
    environment = dataset.environment
    layout = (*row_arrays(dense), environment.observation_dim, environment.action_dim)
    return digest({"format": FORMAT, "layout": layout, "parts": parts})[:32]


def entry_bytes(selection: "Selection", *, dense: bool = False) -> int:
    """The most that a selection's entry takes on disk, in bytes."""
    plan = plan_rows(selection, dense=dense)
    rows, width = table_shape(selection, plan)
    episodes = sum(part.episodes for part in plan)
    return (
        4 * rows * width + 16 * (episodes + len(selection.tasks)) + BLOCK.itemsize * len(plan) + RECORD_BYTES
    )


def open_entry(entry: Path, selection: "Selection") -> PackedRows | None:
    """Opens the rows of an entry and locks it while its table is in use; None if it is missing or damaged."""
    try:
        file = (entry / RECORD).open("rb")
    except FileNotFoundError:
        return None
    with contextlib.ExitStack() as stack:
        stack.enter_context(file)
        take_shared_lock(file)  # an eviction holds the exclusive lock only briefly
        record = read_entry(file)
        if not is_current(file, entry / RECORD) or record is None or record.key != entry.name:
            return None
        if entry_problem(entry, record, limit=CHECKED_BYTES):
            return None
        with contextlib.suppress(OSError):  # a cache that may only be read
            os.utime(entry / RECORD)
        return _map_rows(entry, record, selection, stack.pop_all())


def _map_rows(
    entry: Path, record: EntryRecord, selection: "Selection", lock: contextlib.ExitStack
) -> PackedRows:
    """The rows of a checked entry; its lock is released with the table."""
    with lock:
        data = np.frombuffer((entry / EPISODES).read_bytes(), dtype=np.int64)
        starts, lengths, ranges = np.split(data, [record.episodes, 2 * record.episodes])
        # copy on write, because torch requires writable memory and the file must not change
        table: Table = np.memmap(entry / ROWS, dtype=np.float32, mode="c", shape=record.shape)
        weakref.finalize(table, lock.pop_all().close)
    return selection_rows(selection, table, Episodes(starts, lengths, ranges.reshape(-1, 2)))


def read_entry(file: IO[bytes]) -> EntryRecord | None:
    """Reads a record; None if it is damaged or has another format."""
    recorded, _, data = file.read().partition(b"\n")
    if sha256(data).encode() != recorded:
        return None
    try:
        record = EntryRecord.model_validate_json(data)
    except ValidationError:
        return None
    return record if record.format == FORMAT else None


def entry_problem(entry: Path, record: EntryRecord, *, limit: int | None = None) -> str | None:
    """Why an entry is damaged, in words; None if nothing is found.

    Args:
        entry: its folder.
        record: its record.
        limit: a table above this size, in bytes, is not hashed if its seal holds; None hashes every table.
    """
    contents = {}
    for name, wanted in ((EPISODES, record.episodes_sha256), (BLOCKS, record.blocks_sha256)):
        contents[name] = (entry / name).read_bytes() if (entry / name).is_file() else b""
        if sha256(contents[name]) != wanted:
            return f"{name} is not the file that was written"
    try:
        seal = TableSeal.of(entry / ROWS)
    except FileNotFoundError:
        return f"{ROWS} is missing"
    if seal.size != 4 * record.shape[0] * record.shape[1]:
        return f"{ROWS} has {seal.size} bytes"
    if seal == record.seal and limit is not None and seal.size > limit:
        return None
    return table_problem(entry / ROWS, np.frombuffer(contents[BLOCKS], dtype=BLOCK))


def write_entry(staged: Path, selection: "Selection", *, dense: bool = False) -> PackedRows:
    """Decodes a selection part by part into a staged folder that holds a file of zeros for the table.

    Args:
        staged: the folder; its name is the entry's key.
        selection: the selection.
        dense: with dense rewards.

    Returns:
        The rows, with the entry locked; they stay valid when the folder is renamed.

    Raises:
        SelectionError: a part has no dense rewards.
        StorageError: the operating system refuses a file operation.
        StoreError: arrays cannot be decoded, do not form episodes, or are not those of the part's record.
    """
    plan = plan_rows(selection, dense=dense)
    shape = table_shape(selection, plan)
    with named_errors(staged):
        lengths, blocks = write_table(staged / ROWS, plan, shape)
        episodes = Episodes.of(lengths, [part.task for part in plan])
        record = _write_small_files(staged, selection, episodes, blocks, shape)
        with contextlib.ExitStack() as lock:
            file = lock.enter_context((staged / RECORD).open("rb"))
            take_shared_lock(file)
            disk.sync(staged)
            return _map_rows(staged, record, selection, lock.pop_all())


def _write_small_files(
    staged: Path, selection: "Selection", episodes: Episodes, blocks: Blocks, shape: tuple[int, int]
) -> EntryRecord:
    """Writes everything beside the table, the record last."""
    tables = (episodes.starts, episodes.lengths, episodes.task_ranges)
    contents = {
        EPISODES: b"".join(table.astype(np.int64).tobytes() for table in tables),
        BLOCKS: blocks.tobytes(),
    }
    for name, data in contents.items():
        write_file(staged / name, data)
    record = EntryRecord(
        format=FORMAT,
        key=staged.name,
        environment=selection.dataset.name,
        dataset=printable(str(selection.dataset.folder.resolve())),
        tasks=len(selection.tasks),
        parts=len(blocks),
        shape=shape,
        episodes=len(episodes.starts),
        episodes_sha256=sha256(contents[EPISODES]),
        blocks_sha256=sha256(contents[BLOCKS]),
        seal=TableSeal.of(staged / ROWS),
    )
    text = canonical_json(record.model_dump(mode="json"))
    write_file(staged / RECORD, sha256(text).encode() + b"\n" + text)
    return record
