"""The cache of decoded steps, for selections that do not fit into memory; read through the page cache.

An entry is a folder `<cache>/rows/<key>`; its key is a digest of the dataset's Merkle root and the selection.
If the entries exceed a limit, the least recently used entry that is not in use is evicted.
"""

import contextlib
import fcntl
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    lock_file,
    make_folders,
    remove_abandoned,
    remove_tree,
    try_lock,
)
from tcmrl_data.foundation.errors import CacheError, LockedError, StorageError
from tcmrl_data.foundation.machine import available_memory
from tcmrl_data.foundation.sizes import parse_bytes, size
from tcmrl_data.sampling.cache_entry import (
    FORMAT,
    RECORD,
    is_current,
    open_entry,
    read_entry,
    selected,
    write_entry,
)
from tcmrl_data.sampling.rows import PackedRows, plan_rows, read_rows, table_shape

if TYPE_CHECKING:
    from tcmrl_data.dataset.selection import Selection

CACHE_BYTES = 100 * 10**9
"""Default of TCMRL_CACHE_LIMIT, the maximum size of all entries."""


@dataclass(frozen=True)
class CacheEntry:
    """An entry of the cache.

    Attributes:
        key: name of its folder.
        environment: name of the dataset's environment; empty if the entry is damaged.
        root: Merkle root of the dataset; empty if the entry is damaged.
        tasks: number of selected tasks.
        bytes: size on disk.
        used: Unix time of the last use.
        in_use: True if a process reads the entry.
    """

    key: str
    environment: str
    root: str
    tasks: int
    bytes: int
    used: float
    in_use: bool


def cache_folder() -> Path:
    """TCMRL_CACHE, or `tcmrl` in the user's cache folder (XDG_CACHE_HOME or ~/.cache)."""
    own = os.environ.get("TCMRL_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tcmrl"


def load_rows(
    selection: "Selection",
    *,
    memory_limit: int | None = None,
    say: Callable[[str], None] = lambda message: None,
) -> PackedRows:
    """Loads the rows of a selection into memory, or from the cache if they do not fit.

    Args:
        selection: the selection.
        memory_limit: maximum size of the rows in memory, in bytes; None for half of the available memory.
        say: called with a message if the cache is used.

    Raises:
        CacheError: the rows fit neither into memory nor into the cache.
        StoreError: arrays cannot be decoded or do not form episodes; the message names the part.
    """
    needed = _table_bytes(selection)
    limit = available_memory() // 2 if memory_limit is None else memory_limit
    if needed <= limit:
        return read_rows(selection)
    why = "half of the available memory" if memory_limit is None else "the memory limit"
    say(f"{size(needed)} of steps exceed {why}, {size(limit)}: using the cache")
    return cached_rows(selection, say=say)


def cached_rows(selection: "Selection", *, say: Callable[[str], None] = lambda message: None) -> PackedRows:
    """Opens the rows of a selection from the cache; decodes them into the cache if they are not there.

    The entry is locked against eviction while its table is in use.

    Args:
        selection: the selection.
        say: called with a message before decoding starts.

    Raises:
        CacheError: the cache has no room, or its folder cannot be written.
        StoreError: arrays cannot be decoded or do not form episodes; the message names the part.
    """
    folder = cache_folder()
    root = selection.dataset.manifest.root
    key = digest({"format": FORMAT, "root": root, "selection": selected(selection)})[:32]
    entry = folder / "rows" / key
    for _ in range(2):
        with _named_cache(folder):
            rows = open_entry(entry, selection)
            if rows is not None:
                return rows
            say(f"decoding {selection.dataset.folder} into {entry}; this happens once")
            _remove_abandoned(folder)
            _evict(folder, key)  # an entry that cannot be opened is damaged
            make_folders(folder)
            _make_room(folder, _table_bytes(selection))
            write_entry(folder, entry, selection)
    raise CacheError(f"{entry} was evicted while it was written; raise TCMRL_CACHE_LIMIT")


def list_cache() -> tuple[CacheEntry, ...]:
    """The entries of the cache, least recently used first."""
    found = []
    for entry in _entries(cache_folder()):
        with contextlib.suppress(FileNotFoundError), (entry / RECORD).open("rb") as file:
            record = read_entry(file)
            used = os.fstat(file.fileno()).st_mtime
            num_bytes = sum(path.stat().st_size for path in entry.iterdir())
            in_use = not try_lock(file, fcntl.LOCK_EX)
            about = (record.environment, record.root, len(record.selection)) if record else ("", "", 0)
            found.append(CacheEntry(entry.name, *about, num_bytes, used, in_use))
    return tuple(sorted(found, key=lambda entry: entry.used))


def clear_cache() -> tuple[CacheEntry, ...]:
    """Removes every entry that no process reads; returns the removed entries."""
    folder = cache_folder()
    removed = tuple(entry for entry in list_cache() if _evict(folder, entry.key))
    _remove_abandoned(folder)
    return removed


def cache_limit() -> int:
    """The maximum size of all entries in bytes: TCMRL_CACHE_LIMIT (such as `20G`), or 100 GB.

    Raises:
        CacheError: the variable is not a valid size.
    """
    text = os.environ.get("TCMRL_CACHE_LIMIT")
    return parse_bytes(text) if text else CACHE_BYTES


@contextlib.contextmanager
def _named_cache(folder: Path) -> Iterator[None]:
    """Turns errors of file operations into an error that says how to move the cache.

    Raises:
        CacheError: the operating system refuses a file operation within the block.
    """
    try:
        yield
    except (OSError, StorageError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).partition(";")[0]
        raise CacheError(
            f"the cache {folder} cannot be used ({reason}); set TCMRL_CACHE to a folder that can be written, "
            "or raise --memory-limit"
        ) from None


def _table_bytes(selection: "Selection") -> int:
    rows, width = table_shape(selection, plan_rows(selection))
    return 4 * rows * width


def _entries(folder: Path) -> list[Path]:
    rows = folder / "rows"
    return sorted(path for path in rows.iterdir() if path.is_dir()) if rows.is_dir() else []


def _make_room(folder: Path, needed: int) -> None:
    """Evicts the least recently used entries until a new entry fits below the limit.

    Raises:
        CacheError: the new entry does not fit on the disk.
    """
    entries = list(list_cache())
    limit = cache_limit()
    while entries and sum(entry.bytes for entry in entries) + needed > limit:
        _evict(folder, entries.pop(0).key)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise CacheError(
            f"{folder}: decoded steps take {size(needed)}, {size(free)} are free; make room, "
            "set TCMRL_CACHE to a folder on another disk, or raise --memory-limit"
        )


def _evict(folder: Path, key: str) -> bool:
    """Removes an entry unless a process reads it; renames it first, so that no process opens a part of it."""
    entry = folder / "rows" / key
    if not entry.is_dir():
        return False
    with contextlib.ExitStack() as stack:
        if (entry / RECORD).is_file():
            file = stack.enter_context((entry / RECORD).open("rb"))
            if not try_lock(file, fcntl.LOCK_EX) or not is_current(file, entry / RECORD):
                return False
        make_folders(folder / STAGING)
        evicted = folder / STAGING / f"evicted.{uuid.uuid4().hex}"
        os.replace(entry, evicted)
        remove_tree(evicted)
    return True


def _remove_abandoned(folder: Path) -> None:
    """Removes files of killed processes from the staging folder."""
    if (folder / STAGING).is_dir():
        with contextlib.suppress(LockedError), lock_file(folder / LOCK, f"cache {folder}"):
            remove_abandoned(folder)
