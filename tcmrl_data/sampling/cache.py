"""The cache of decoded steps, for selections that do not fit into memory; read through the page cache.

An entry is a folder `<cache>/rows/<key>`; its key is a digest of the selected parts' ids, and every array is
checked against its part's record while it is decoded, so that a forged dataset cannot take the place of
another. All entries, those being written included, stay below TCMRL_CACHE_LIMIT: the least recently used
entry that is not in use is evicted. Of several processes that need the same entry, one decodes, others wait.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tcmrl_data.foundation.errors import CacheError, StorageError
from tcmrl_data.foundation.locks import take_shared_lock
from tcmrl_data.foundation.machine import available_memory, parse_bytes, size
from tcmrl_data.sampling.cache_entry import (
    RECORD,
    entry_bytes,
    entry_key,
    entry_problem,
    open_entry,
    read_entry,
    write_entry,
)
from tcmrl_data.sampling.cache_room import (
    CacheEntry,
    entries,
    entry_folder,
    evict,
    only_writer,
    publish,
    reserve,
)
from tcmrl_data.sampling.rows import PackedRows, plan_rows, read_rows, table_shape

if TYPE_CHECKING:
    from tcmrl_data.dataset.selection import Selection

CACHE_BYTES = 100 * 10**9
"""Default of TCMRL_CACHE_LIMIT, the maximum size of all entries."""


def cache_folder() -> Path:
    """TCMRL_CACHE, or `tcmrl` in the user's cache folder (XDG_CACHE_HOME or ~/.cache)."""
    own = os.environ.get("TCMRL_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tcmrl"


def load_rows(
    selection: "Selection",
    *,
    dense: bool = False,
    memory_limit: int | None = None,
    say: Callable[[str], None] = lambda message: None,
) -> PackedRows:
    """Loads the rows of a selection into memory, or from the cache if they do not fit.

    Args:
        selection: the selection.
        dense: load dense rewards too.
        memory_limit: maximum size of the rows in memory, in bytes; None for half of the available memory.
        say: called with a message if the cache is used.

    Raises:
        CacheError: the rows fit neither into memory nor into the cache.
        SelectionError: a part has no dense rewards.
        StoreError: arrays cannot be decoded or do not form episodes; the message names the part.
    """
    needed = _table_bytes(selection, dense)
    limit = available_memory() // 2 if memory_limit is None else memory_limit
    if needed <= limit:
        return read_rows(selection, dense=dense)
    why = "half of the available memory" if memory_limit is None else "the memory limit"
    say(f"{size(needed)} of steps exceed {why}, {size(limit)}: using the cache")
    return cached_rows(selection, dense=dense, say=say)


def cached_rows(
    selection: "Selection", *, dense: bool = False, say: Callable[[str], None] = lambda message: None
) -> PackedRows:
    """Opens the rows of a selection from the cache; decodes them into the cache if they are not there.

    If another process decodes them, this one waits; it decodes them itself if the other ends before.
    The entry is locked against eviction while its table is in use.

    Args:
        selection: the selection.
        dense: with dense rewards; they have an entry of their own.
        say: called with a message before decoding, and before waiting, starts.

    Raises:
        CacheError: the cache has no room, or its folder cannot be written.
        SelectionError: a part has no dense rewards.
        StoreError: arrays cannot be decoded, do not form episodes, or are not those that the part's record
            names; the message names the part.
    """
    folder, key = cache_folder(), entry_key(selection, dense=dense)
    entry = entry_folder(folder, key)
    with _named_cache(folder):
        rows = open_entry(entry, selection)
        if rows is not None:
            return rows
        with only_writer(folder, key, say):
            rows = open_entry(entry, selection)  # another process may have decoded it meanwhile
            if rows is None:
                say(f"decoding {selection.dataset.folder} into {entry}; this happens once")
                needed = entry_bytes(selection, dense=dense)
                staged = reserve(folder, key, needed=needed, limit=cache_limit())
                rows = write_entry(staged, selection, dense=dense)
                publish(folder, key)
            return rows


def list_cache() -> tuple[CacheEntry, ...]:
    """The entries of the cache, least recently used first."""
    return tuple(entries(cache_folder()))


def clear_cache() -> tuple[CacheEntry, ...]:
    """Removes every entry that no process reads; returns the removed entries.

    Raises:
        CacheError: the cache's folder cannot be written.
    """
    return _remove(list_cache())


def verify_cache() -> tuple[tuple[CacheEntry, str], ...]:
    """Hashes all entries and removes the damaged ones that no process reads.

    Returns:
        The damaged entries, each with its problem in words; `list_cache` still holds those that are in use.

    Raises:
        CacheError: a damaged entry cannot be removed, because the cache's folder cannot be written.
    """
    found = ((entry, _problem(entry_folder(cache_folder(), entry.key))) for entry in list_cache())
    damaged = tuple((entry, problem) for entry, problem in found if problem)
    if damaged:
        _remove(tuple(entry for entry, _ in damaged))
    return damaged


def _problem(entry: Path) -> str | None:
    """Why an entry is damaged, in words; it is not evicted meanwhile."""
    try:
        with (entry / RECORD).open("rb") as file:
            take_shared_lock(file)
            record = read_entry(file)
            if record is None or record.key != entry.name:
                return f"{RECORD} is damaged, or of another version"
            return entry_problem(entry, record)
    except FileNotFoundError:  # evicted meanwhile
        return None


def _remove(chosen: tuple[CacheEntry, ...]) -> tuple[CacheEntry, ...]:
    with _named_cache(cache_folder()):
        removed = evict(cache_folder(), [entry.key for entry in chosen])
    return tuple(entry for entry in chosen if entry.key in removed)


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


def _table_bytes(selection: "Selection", dense: bool) -> int:
    rows, width = table_shape(selection, plan_rows(selection, dense=dense))
    return 4 * rows * width
