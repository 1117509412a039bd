"""One entry of the cache: packed rows as files that are mapped into memory.

`rows.f32` is the table. `episodes.i64` holds starts, lengths and task ranges. `record.json` holds the digest
of the record in its first line, then the record. An entry is forced to disk, published by one rename, and
never changes. A reader holds a shared lock on its record.
"""

import contextlib
import fcntl
import os
import uuid
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from tcmrl_data.foundation.canonical import canonical_json, sha256
from tcmrl_data.foundation.disk import (
    STAGING,
    disk,
    lock_file,
    make_folders,
    move_into_place,
    named_errors,
    remove_tree,
    write_file,
)
from tcmrl_data.sampling.rows import (
    Episodes,
    Indices,
    PackedRows,
    PartRows,
    Table,
    map_parts,
    plan_rows,
    read_part,
    selection_rows,
    table_shape,
)

if TYPE_CHECKING:
    from tcmrl_data.dataset.selection import Selection

FORMAT = 1
"""Increased when the layout of an entry changes; entries of another format are not opened."""

RECORD = "record.json"
ROWS = "rows.f32"
EPISODES = "episodes.i64"


class EntryRecord(BaseModel):
    """Description of an entry.

    Attributes:
        format: FORMAT of the version that wrote the entry.
        environment: name of the dataset's environment.
        root: Merkle root of the dataset.
        selection: (index, snapshot steps) per task.
        shape: (rows, floats per row) of the table.
        episodes: number of episodes with at least one step.
        episodes_sha256: digest of the file of episodes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int
    environment: str
    root: str
    selection: tuple[tuple[int, tuple[int, ...]], ...]
    shape: tuple[int, int]
    episodes: int
    episodes_sha256: str

    @property
    def row_bytes(self) -> int:
        """Size of the file of rows."""
        return 4 * self.shape[0] * self.shape[1]


def open_entry(entry: Path, selection: "Selection") -> PackedRows | None:
    """Opens the rows of an entry and locks it while its table is in use; None if it is missing or damaged."""
    try:
        file = (entry / RECORD).open("rb")
    except FileNotFoundError:
        return None
    with contextlib.ExitStack() as stack:
        stack.enter_context(file)
        fcntl.flock(file, fcntl.LOCK_SH)  # an eviction or a listing holds the exclusive lock only briefly
        record = read_entry(file)
        if not is_current(file, entry / RECORD) or record is None:
            return None
        episodes = _read_episodes(entry / EPISODES, record, len(selection.tasks))
        if episodes is None or not _has_size(entry / ROWS, record.row_bytes):
            return None
        os.utime(entry / RECORD)
        # copy on write, because torch requires writable memory and the file must not change
        table: Table = np.memmap(entry / ROWS, dtype=np.float32, mode="c", shape=record.shape)
        weakref.finalize(table, stack.pop_all().close)
        return selection_rows(selection, table, episodes)


def _has_size(path: Path, size: int) -> bool:
    return path.is_file() and path.stat().st_size == size


def is_current(file: IO[bytes], path: Path) -> bool:
    """Whether the path still refers to the open file."""
    return path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())


def selected(selection: "Selection") -> tuple[tuple[int, tuple[int, ...]], ...]:
    """A selection as (task index, snapshot steps) per task."""
    return tuple((task.index, selection.steps[task.index]) for task in selection.tasks)


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


def _read_episodes(file: Path, record: EntryRecord, num_tasks: int) -> Episodes | None:
    data = file.read_bytes() if file.is_file() else b""
    if sha256(data) != record.episodes_sha256:
        return None
    starts, lengths, ranges = np.split(
        np.frombuffer(data, dtype=np.int64), [record.episodes, 2 * record.episodes]
    )
    return Episodes(starts, lengths, ranges.reshape(num_tasks, 2))


def write_entry(folder: Path, entry: Path, selection: "Selection") -> None:
    """Decodes a selection part by part into a new entry; does nothing if the entry exists at the end.

    Args:
        folder: the cache.
        entry: folder of the entry.
        selection: the selection.

    Raises:
        StorageError: the operating system refuses a file operation; nothing is published.
        StoreError: arrays cannot be decoded or do not form episodes; the message names the part.
    """
    plan = plan_rows(selection)
    shape = table_shape(selection, plan)
    make_folders(folder / STAGING)
    make_folders(entry.parent)
    staged = folder / STAGING / f"{entry.name}.{uuid.uuid4().hex}"
    with lock_file(staged.with_name(f"{staged.name}.lock"), "this entry") as lock:
        try:
            with named_errors(staged):
                disk.make_folder(staged)
                lengths = _write_rows(staged / ROWS, plan, shape)
            episodes = Episodes.of(lengths, [part.task for part in plan])
            tables = (episodes.starts, episodes.lengths, episodes.task_ranges)
            data = b"".join(table.astype(np.int64).tobytes() for table in tables)
            record = EntryRecord(
                format=FORMAT,
                environment=selection.dataset.name,
                root=selection.dataset.manifest.root,
                selection=selected(selection),
                shape=shape,
                episodes=len(episodes.starts),
                episodes_sha256=sha256(data),
            )
            write_file(staged / EPISODES, data)
            text = canonical_json(record.model_dump(mode="json"))
            write_file(staged / RECORD, sha256(text).encode() + b"\n" + text)
            with named_errors(staged):
                disk.sync(staged)
            move_into_place(staged, entry)
        finally:
            remove_tree(staged)
            lock.unlink(missing_ok=True)


def _write_rows(file: Path, plan: Sequence[PartRows], shape: tuple[int, int]) -> list[Indices]:
    """Writes the table part by part, so that only the parts being read are in memory."""
    with file.open("xb", buffering=0) as out:
        out.truncate(4 * shape[0] * shape[1])

        def write(part: PartRows) -> Indices:
            rows: Table = np.zeros((part.last - part.first, shape[1]), dtype=np.float32)
            lengths = read_part(part, rows)
            remaining, offset = memoryview(rows.data).cast("B"), 4 * shape[1] * part.first
            while remaining:
                written = os.pwrite(out.fileno(), remaining, offset)
                remaining, offset = remaining[written:], offset + written
            return lengths

        lengths = list(map_parts(plan, write))
    disk.sync(file)
    return lengths
