"""Room in the cache: what lies in it, what is evicted, and room for an entry that is being written.

An entry is written in `.staging/<key>`, under the lock `.staging/<key>.lock`: one process decodes, others
wait. From the start, the staged table is as long as the entry will be, so that its length is its reservation.
Whatever changes how much room is taken happens under the cache's own lock, `.lock`.
"""

import contextlib
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    disk,
    is_current,
    lock_file,
    make_folders,
    move_into_place,
    named_errors,
    remove_abandoned,
    remove_tree,
)
from tcmrl_data.foundation.errors import CacheError, LockedError
from tcmrl_data.foundation.locks import is_locked, try_exclusive_lock
from tcmrl_data.foundation.machine import size
from tcmrl_data.sampling.cache_entry import RECORD, ROWS, read_entry

WAIT_SECONDS = 0.2
"""Interval at which a process that waits for a lock tries again."""


@dataclass(frozen=True)
class CacheEntry:
    """An entry of the cache.

    Attributes:
        key: name of its folder.
        environment: name of the dataset's environment; empty if the entry is damaged.
        dataset: folder of the dataset that it was decoded from; empty if the entry is damaged.
        tasks: number of selected tasks.
        parts: number of selected parts.
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


def entry_folder(folder: Path, key: str) -> Path:
    """The folder of an entry."""
    return folder / "rows" / key


def entries(folder: Path) -> list[CacheEntry]:
    """The entries of a cache, least recently used first."""
    rows, found = folder / "rows", []
    for entry in sorted(path for path in rows.iterdir() if path.is_dir()) if rows.is_dir() else []:
        with contextlib.suppress(FileNotFoundError):  # evicted meanwhile
            found.append(_look_at(entry))
    return sorted(found, key=lambda entry: entry.used)


def _look_at(entry: Path) -> CacheEntry:
    record, used, in_use = None, entry.stat().st_mtime, False
    if (entry / RECORD).is_file():
        with (entry / RECORD).open("rb") as file:
            record, used, in_use = read_entry(file), os.fstat(file.fileno()).st_mtime, is_locked(file)
    about = (record.environment, record.dataset, record.tasks, record.parts) if record else ("", "", 0, 0)
    return CacheEntry(entry.name, *about, _bytes_in(entry), used, in_use)


def _bytes_in(folder: Path) -> int:
    return sum(status.st_size for status in _statuses(folder))


def _statuses(folder: Path) -> Iterator[os.stat_result]:
    """What the system says of a folder's files, while another process may be removing them."""
    with contextlib.suppress(FileNotFoundError):
        for path in list(folder.iterdir()):
            with contextlib.suppress(FileNotFoundError):
                yield path.stat()


@contextlib.contextmanager
def waited_lock(path: Path, what: str, say: Callable[[str], None] = lambda message: None) -> Iterator[None]:
    """Holds an exclusive lock; waits while another process holds it, and goes on when that process ends.

    Args:
        path: the lock file; its folder exists.
        what: what the lock stands for.
        say: called with a message that names the holder, again when the holder changes; a process that
            holds the lock only for a moment is not named.

    Raises:
        ReadOnlyError: the folder cannot be written.
    """
    seen = said = ""
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(lock_file(path, what))
                break
            except LockedError as error:
                holder = str(error).partition(";")[0]
            if holder == seen != said:
                say(f"{holder}; waiting for it")
                said = holder
            seen = holder
            time.sleep(WAIT_SECONDS)
        yield


@contextlib.contextmanager
def only_writer(folder: Path, key: str, say: Callable[[str], None]) -> Iterator[None]:
    """Makes this process the only one that writes an entry; waits for another one that does.

    Raises:
        StorageError: the cache cannot be written.
    """
    make_folders(folder / STAGING)
    lock = folder / STAGING / f"{key}.lock"
    with waited_lock(lock, str(entry_folder(folder, key)), say):
        try:
            yield
        finally:
            remove_tree(folder / STAGING / key)
            lock.unlink(missing_ok=True)


def reserve(folder: Path, key: str, *, needed: int, limit: int) -> Path:
    """A staged folder with a file of zeros for the table, which takes the entry's room from now on.

    An entry of this key is removed; whoever calls found it damaged, and is its only writer.

    Args:
        folder: the cache.
        key: the entry's key.
        needed: the most that the entry takes, in bytes.
        limit: the most that all entries may take, in bytes.

    Raises:
        CacheError: the entry does not fit beside those in use, or on the disk, or is itself in use.
        StorageError: the operating system refuses a file operation.
    """
    staged = folder / STAGING / key
    with _room_lock(folder):
        remove_abandoned(folder)
        remove_tree(staged)
        if entry_folder(folder, key).is_dir() and not _evict(folder, key):
            raise CacheError(
                f"{entry_folder(folder, key)} is damaged, and another process reads it; stop that process, "
                "then run the same command again"
            )
        _make_room(folder, needed, limit)
        with named_errors(staged):
            disk.make_folder(staged)
            with (staged / ROWS).open("xb") as file:
                file.truncate(needed)
    return staged


def publish(folder: Path, key: str) -> None:
    """Moves a staged entry to its place, which is free.

    Raises:
        StorageError: the operating system refuses a file operation.
    """
    entry = entry_folder(folder, key)
    make_folders(entry.parent)
    with _room_lock(folder):
        move_into_place(folder / STAGING / key, entry)


def evict(folder: Path, keys: list[str]) -> list[str]:
    """Removes entries that no process reads, and what killed processes left; returns the keys of the removed.

    Raises:
        OSError: the cache cannot be written.
        StorageError: the cache cannot be written.
    """
    if not folder.is_dir():
        return []
    with _room_lock(folder):
        remove_abandoned(folder)
        return [key for key in keys if _evict(folder, key)]


@contextlib.contextmanager
def _room_lock(folder: Path) -> Iterator[None]:
    with waited_lock(folder / LOCK, f"the cache {folder}"):
        yield


def _make_room(folder: Path, needed: int, limit: int) -> None:
    """Evicts the least recently used entries until a new entry fits; evicts none if it cannot fit."""
    staged = [path for path in (folder / STAGING).iterdir() if path.is_dir()]
    found = entries(folder)
    idle = [entry for entry in found if not entry.in_use]
    taken = sum(map(_bytes_in, staged)) + sum(entry.bytes for entry in found)
    kept = taken - sum(entry.bytes for entry in idle)
    while idle and kept + needed <= limit < taken + needed:
        entry = idle.pop(0)
        if _evict(folder, entry.key):
            taken -= entry.bytes
        else:
            kept += entry.bytes
    if taken + needed > limit:
        raise CacheError(
            f"{folder}: decoded steps take {size(needed)}, {size(kept)} are in use or being written, and the "
            f"cache is limited to {size(limit)}; raise TCMRL_CACHE_LIMIT or --memory-limit, or wait for the "
            "other processes"
        )
    free = shutil.disk_usage(folder).free - sum(map(_unwritten, staged))
    if needed > free:
        raise CacheError(
            f"{folder}: decoded steps take {size(needed)}, {size(max(0, free))} are free; make room, "
            "set TCMRL_CACHE to a folder on another disk, or raise --memory-limit"
        )


def _unwritten(staged: Path) -> int:
    """Bytes that an entry being written will still take from the disk."""
    return sum(max(0, status.st_size - 512 * status.st_blocks) for status in _statuses(staged))


def _evict(folder: Path, key: str) -> bool:
    """Removes an entry unless a process reads it; renames it first, so that no process opens a part of it."""
    entry = entry_folder(folder, key)
    if not entry.is_dir():
        return False
    with contextlib.ExitStack() as stack:
        if (entry / RECORD).is_file():
            file = stack.enter_context((entry / RECORD).open("r+b"))
            if not try_exclusive_lock(file) or not is_current(file, entry / RECORD):
                return False
        make_folders(folder / STAGING)
        evicted = folder / STAGING / f"evicted.{uuid.uuid4().hex}"
        os.replace(entry, evicted)
        remove_tree(evicted)
    return True
