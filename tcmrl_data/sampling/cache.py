"""The cache of decoded steps, for selections that do not fit into memory.

An entry is one file `<cache>/rows/<key>.bin`; its key is a digest of the selected parts' ids, and every array
is checked against its part's record while it is decoded, so that a forged dataset cannot take the place of
another. The file holds a record with the digest of all that follows it, the table of packed rows, which is
mapped into memory, and the length of every episode. It is written once, forced to disk, published by one
rename, and never changes.

One process writes at a time, under the cache's lock; others wait. Before it writes, the least recently used
entries are removed until all fit below TCMRL_CACHE_LIMIT. A reader holds a shared lock on its entry, so that
no entry in use is removed.

A file of up to CHECKED_BYTES is hashed whenever it is opened. Nothing
here guards against a person who may write to the cache's folder: give write access only to those who are
trusted.
"""

import contextlib
import hashlib
import os
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from pydantic import ValidationError

from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    disk,
    is_current,
    lock_file,
    make_folders,
    move_into_place,
    remove_tree,
)
from tcmrl_data.foundation.errors import CacheError, LockedError, StorageError
from tcmrl_data.foundation.files import is_locked, printable, take_shared_lock, try_exclusive_lock
from tcmrl_data.foundation.machine import available_cores, cache_folder, cache_limit, size
from tcmrl_data.foundation.records import Record, digest, record_bytes
from tcmrl_data.sampling.rows import (
    READERS,
    PackedRows,
    Table,
    fill_table,
    pack_rows,
    plan_rows,
    row_arrays,
    table_shape,
)

if TYPE_CHECKING:
    from tcmrl_data.dataset.selection import Selection

CHECKED_BYTES = 10**9
"""A file up to this size is hashed whenever it is opened, which takes about a second on one core."""

FORMAT = 4
"""Part of every key; increased when the layout of an entry changes."""

RECORD_BYTES = 2**13
"""What the record takes at the beginning of a file, filled up with spaces."""

PIECE_BYTES = 2**22
"""Files are hashed in pieces of this size, several at a time."""

WAIT_SECONDS = 0.2
"""Interval at which a process that waits for the lock tries again."""


@dataclass(frozen=True)
class CacheEntry:
    """An entry of the cache.

    Attributes:
        key: name of its file, without `.bin`.
        environment: name of the dataset's environment; empty if the entry is damaged.
        dataset: folder that it was decoded from; equal parts elsewhere share the entry. Empty if damaged.
        bytes: size on disk.
        used: Unix time of the last use.
        in_use: True if a process reads the entry.
    """

    key: str
    environment: str
    dataset: str
    tasks: int
    parts: int
    bytes: int
    used: float
    in_use: bool


class EntryRecord(Record):
    """The beginning of an entry's file; `digest` is that of what follows, see `_digest_of`."""

    environment: str
    dataset: str
    tasks: int
    parts: int
    digest: str


def cached_rows(
    selection: "Selection", *, dense: bool = False, say: Callable[[str], None] | None = None
) -> PackedRows:
    """Opens the rows of a selection from the cache; decodes them into the cache if they are not there.

    If another process decodes, this one waits; it decodes the rows itself if the other ends before.

    Args:
        dense: load dense rewards too; they have an entry of their own.
        say: called with a message before decoding, and before waiting, starts.

    Raises:
        CacheError: the cache has no room, or its folder cannot be written.
        StoreError: arrays cannot be decoded, do not form episodes, or are not those that the part's record
            names; the message names the part.
    """
    folder = cache_folder()
    entry = _file_of(entry_key(selection, dense=dense))
    with _named_cache(folder):
        rows = _open_entry(entry, selection, dense)
        if rows is not None:
            return rows
        make_folders(folder)
        with _writer_lock(folder, say):
            rows = _open_entry(entry, selection, dense)  # another process may have decoded it meanwhile
            if rows is None:
                if say:
                    say(f"decoding {selection.dataset.path} into {entry}; this happens once")
                _write_entry(folder, entry, selection, dense)
                rows = _open_entry(entry, selection, dense, checked=0)  # it was hashed just now
    if rows is None:
        raise CacheError(f"{entry} changed while it was written; run the same command again")
    return rows


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
    """The size of a selection's entry on disk."""
    plan = plan_rows(selection, dense=dense)
    rows, width = table_shape(selection, plan)
    return RECORD_BYTES + 4 * rows * width + 8 * sum(part.episodes for part in plan)


def _file_of(key: str) -> Path:
    return cache_folder() / "rows" / f"{key}.bin"


def _open_entry(
    entry: Path, selection: "Selection", dense: bool, *, checked: int | None = None
) -> PackedRows | None:
    """The rows of an entry, which is locked while its table is in use; None if it is missing or damaged.

    A file of up to `checked` bytes is hashed, by default of up to CHECKED_BYTES.
    """
    with contextlib.ExitStack() as lock:
        try:
            file = lock.enter_context(entry.open("rb"))
        except FileNotFoundError:
            return None
        take_shared_lock(file)  # whoever removes an entry holds the exclusive lock only briefly
        limit = CHECKED_BYTES if checked is None else checked
        is_whole = os.fstat(file.fileno()).st_size == entry_bytes(selection, dense=dense)
        if not is_current(file, entry) or not is_whole or _is_damaged(file, limit=limit):
            return None
        with contextlib.suppress(OSError):  # a cache that may only be read
            os.utime(entry)
        plan = plan_rows(selection, dense=dense)
        shape = table_shape(selection, plan)
        # copy on write, because torch requires writable memory and the file must not change
        table: Table = np.memmap(entry, dtype=np.float32, mode="c", offset=RECORD_BYTES, shape=shape)
        lengths = np.fromfile(entry, dtype=np.int64, offset=RECORD_BYTES + table.nbytes)
        weakref.finalize(table, lock.pop_all().close)
        return pack_rows(selection, plan, table, lengths)


def _write_entry(folder: Path, entry: Path, selection: "Selection", dense: bool) -> None:
    """Decodes a selection part by part into a staged file, and publishes it; called by the only writer."""
    if entry.exists() and not _remove(entry):
        raise CacheError(
            f"{entry} is damaged, and another process reads it; stop that process, then run the same command "
            "again"
        )
    remove_tree(folder / STAGING)  # what a killed process left
    _make_room(folder, entry_bytes(selection, dense=dense))
    staged = folder / STAGING / entry.name
    make_folders(staged.parent)
    make_folders(entry.parent)
    try:
        plan = plan_rows(selection, dense=dense)
        shape = table_shape(selection, plan)
        with staged.open("xb") as file:  # reserves blocks: in the map, a full disk ends the process
            os.posix_fallocate(file.fileno(), 0, entry_bytes(selection, dense=dense))
        table = np.memmap(staged, dtype=np.float32, mode="r+", offset=RECORD_BYTES, shape=shape)
        lengths = fill_table(table, plan, check_digests=True)
        with staged.open("r+b") as file:
            file.seek(RECORD_BYTES + table.nbytes)
            file.write(lengths.tobytes())
            file.flush()
            record = EntryRecord(
                environment=selection.dataset.name,
                dataset=printable(str(selection.dataset.folder.resolve())),
                tasks=len(selection.tasks),
                parts=len(plan),
                digest=_digest_of(file),
            )
            file.seek(0)
            file.write(record_bytes(record).ljust(RECORD_BYTES))
        disk.sync(staged)
        move_into_place(staged, entry)
    finally:
        remove_tree(folder / STAGING)


def _read_record(file: BinaryIO) -> EntryRecord | None:
    try:
        return EntryRecord.model_validate_json(os.pread(file.fileno(), RECORD_BYTES, 0))
    except ValidationError:
        return None


def _is_damaged(file: BinaryIO, *, limit: int) -> bool:
    """Whether an entry is not as it was written; a file above `limit` bytes is not hashed."""
    record = _read_record(file)
    if record is None:
        return True
    return os.fstat(file.fileno()).st_size <= limit and _digest_of(file) != record.digest


def _digest_of(file: BinaryIO) -> str:
    """The sha256 of the sha256 of the pieces behind the record, which several threads hash."""
    descriptor = file.fileno()

    def hash_piece(start: int) -> bytes:
        return hashlib.sha256(os.pread(descriptor, PIECE_BYTES, start)).digest()

    with ThreadPoolExecutor(min(READERS, available_cores())) as pool:
        pieces = pool.map(hash_piece, range(RECORD_BYTES, os.fstat(descriptor).st_size, PIECE_BYTES))
        return hashlib.sha256(b"".join(pieces)).hexdigest()


def list_cache() -> tuple[CacheEntry, ...]:
    """The entries of the cache, least recently used first."""
    found = []
    for file in (cache_folder() / "rows").glob("*.bin"):
        with contextlib.suppress(FileNotFoundError), file.open("rb") as opened:  # removed meanwhile
            found.append(_look_at(file, opened))
    return tuple(sorted(found, key=lambda entry: (entry.used, entry.key)))


def _look_at(file: Path, opened: BinaryIO) -> CacheEntry:
    record, status = _read_record(opened), os.fstat(opened.fileno())
    about = (record.environment, record.dataset, record.tasks, record.parts) if record else ("", "", 0, 0)
    return CacheEntry(file.stem, *about, status.st_size, status.st_mtime, is_locked(opened))


def clear_cache() -> tuple[CacheEntry, ...]:
    """Removes every entry that no process reads; returns the removed entries.

    Raises:
        CacheError: the cache's folder cannot be written.
    """
    with _named_cache(cache_folder()):
        return tuple(entry for entry in list_cache() if _remove(_file_of(entry.key)))


def _make_room(folder: Path, needed: int) -> None:
    """Removes the least recently used entries until a new entry fits; removes none if it cannot fit."""
    limit, entries = cache_limit(), list_cache()
    kept = sum(entry.bytes for entry in entries if entry.in_use)
    taken = sum(entry.bytes for entry in entries)
    for entry in entries:
        if entry.in_use or not kept + needed <= limit < taken + needed:
            continue
        if _remove(_file_of(entry.key)):
            taken -= entry.bytes
        else:
            kept += entry.bytes
    if taken + needed > limit:
        raise CacheError(
            f"{folder}: decoded steps take {size(needed)}, {size(kept)} are in use, and the cache is limited "
            f"to {size(limit)}; raise TCMRL_CACHE_LIMIT or --memory-limit, or wait for the other processes"
        )


def _remove(entry: Path) -> bool:
    with contextlib.suppress(FileNotFoundError), entry.open("r+b") as file:
        if not try_exclusive_lock(file) or not is_current(file, entry):
            return False
        entry.unlink()
    return True


@contextlib.contextmanager
def _writer_lock(folder: Path, say: Callable[[str], None] | None) -> Iterator[None]:
    """Holds the cache's lock; waits while another process holds it, and names it if it is seen twice."""
    seen = said = ""
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(lock_file(folder / LOCK, f"the cache {folder}"))
                break
            except LockedError as error:
                holder = str(error).partition(";")[0]
            if say and holder == seen != said:
                say(f"{holder}; waiting for it")
                said = holder
            seen = holder
            time.sleep(WAIT_SECONDS)
        yield


@contextlib.contextmanager
def _named_cache(folder: Path) -> Iterator[None]:
    """Turns errors of file operations into an error that says how to move the cache."""
    try:
        yield
    except (OSError, StorageError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).partition(";")[0]
        raise CacheError(
            f"the cache {folder} cannot be used ({reason}); set TCMRL_CACHE to a folder that can be written, "
            "or raise --memory-limit"
        ) from None
