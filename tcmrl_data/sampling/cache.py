"""The cache of decoded steps: for selections that do not fit into memory, read through the page cache.

Entries lie in `<cache>/rows/<key>`; the key is made of the dataset's Merkle root and the selection. Together
they stay under a cap; what was used longest ago goes first, what is in use stays.
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
"""What all entries may take, unless TCMRL_CACHE_LIMIT says otherwise (such as 20G)."""


@dataclass(frozen=True)
class CacheEntry:
    """An entry of the cache, for people.

    Attributes:
        bytes: on disk.
        used: Unix time of its latest use.
        in_use: a process reads it now.
    """

    key: str
    environment: str
    root: str
    tasks: int
    bytes: int
    used: float
    in_use: bool


def cache_folder() -> Path:
    """TCMRL_CACHE, or `tcmrl` in the user's cache folder (XDG_CACHE_HOME, or ~/.cache)."""
    own = os.environ.get("TCMRL_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tcmrl"


def load_rows(
    selection: "Selection",
    *,
    memory_limit: int | None = None,
    say: Callable[[str], None] = lambda message: None,
) -> PackedRows:
    """The rows of a selection: in memory where they fit, else from the cache.

    Args:
        selection: what to read.
        memory_limit: bytes that the rows may take in memory; half of what is available if left out.
        say: told when the cache is used, and why.

    Raises:
        CacheError: they do not fit, and the cache cannot take them.
        StoreError: arrays that do not decode or do not form episodes; names the part.
    """
    needed = _table_bytes(selection)
    limit = available_memory() // 2 if memory_limit is None else memory_limit
    if needed <= limit:
        return read_rows(selection)
    why = "half of the available memory" if memory_limit is None else "the memory limit"
    say(f"{size(needed)} of steps exceed {why}, {size(limit)}: using the cache")
    return cached_rows(selection, say=say)


def cached_rows(selection: "Selection", *, say: Callable[[str], None] = lambda message: None) -> PackedRows:
    """The rows of a selection from the cache, decoded into it first where they are not there.

    The entry stays locked against eviction as long as its table is in use.

    Args:
        selection: what to read.
        say: told of decoding before it starts.

    Raises:
        CacheError: no room, or the folder cannot be written.
        StoreError: arrays that do not decode or do not form episodes; names the part.
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
            _evict(folder, key)  # what lies there is torn
            make_folders(folder)
            _make_room(folder, _table_bytes(selection))
            write_entry(folder, entry, selection)
    raise CacheError(f"{entry} vanishes as it is made; give TCMRL_CACHE_LIMIT more room")


def list_cache() -> tuple[CacheEntry, ...]:
    """The entries of the cache, least recently used first."""
    found = []
    for entry in _entries(cache_folder()):
        with contextlib.suppress(FileNotFoundError), (entry / RECORD).open("rb") as file:
            record = read_entry(file)
            used, size = (
                os.fstat(file.fileno()).st_mtime,
                sum(each.stat().st_size for each in entry.iterdir()),
            )
            in_use = not try_lock(file, fcntl.LOCK_EX)
            about = (record.environment, record.root, len(record.selection)) if record else ("", "", 0)
            found.append(CacheEntry(entry.name, *about, size, used, in_use))
    return tuple(sorted(found, key=lambda each: each.used))


def clear_cache() -> tuple[CacheEntry, ...]:
    """Removes every entry that no process reads; returns those that were removed."""
    folder = cache_folder()
    removed = tuple(each for each in list_cache() if _evict(folder, each.key))
    _remove_abandoned(folder)
    return removed


def cache_limit() -> int:
    """What all entries may take: TCMRL_CACHE_LIMIT, or 100 GB.

    Raises:
        CacheError: the variable is no size.
    """
    text = os.environ.get("TCMRL_CACHE_LIMIT")
    return parse_bytes(text) if text else CACHE_BYTES


@contextlib.contextmanager
def _named_cache(folder: Path) -> Iterator[None]:
    """Turns a refusal of the disk into an error that says where the cache may lie instead.

    Raises:
        CacheError: the disk refuses.
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
    return sorted(each for each in rows.iterdir() if each.is_dir()) if rows.is_dir() else []


def _make_room(folder: Path, needed: int) -> None:
    """Evicts what was used longest ago until a new entry fits under the cap and on the disk.

    Raises:
        CacheError: it does not fit on the disk.
    """
    entries = list(list_cache())
    limit = cache_limit()
    while entries and sum(each.bytes for each in entries) + needed > limit:
        _evict(folder, entries.pop(0).key)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise CacheError(
            f"{folder}: decoded steps take {size(needed)}, {size(free)} are free; make room, "
            "set TCMRL_CACHE to a folder on another disk, or raise --memory-limit"
        )


def _evict(folder: Path, key: str) -> bool:
    """Removes an entry unless a process reads it; renamed first, so that nobody opens half of it."""
    entry = folder / "rows" / key
    if not entry.is_dir():
        return False
    with contextlib.ExitStack() as stack:
        if (entry / RECORD).is_file():
            file = stack.enter_context((entry / RECORD).open("rb"))
            if not try_lock(file, fcntl.LOCK_EX) or not is_current(file, entry / RECORD):
                return False
        make_folders(folder / STAGING)
        gone = folder / STAGING / f"evicted.{uuid.uuid4().hex}"
        os.replace(entry, gone)
        remove_tree(gone)
    return True


def _remove_abandoned(folder: Path) -> None:
    """Removes what killed processes left in the staging folder."""
    if (folder / STAGING).is_dir():
        with contextlib.suppress(LockedError), lock_file(folder / LOCK, f"cache {folder}"):
            remove_abandoned(folder)
