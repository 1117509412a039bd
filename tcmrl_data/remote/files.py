"""The files of a dataset beyond this disk: whole parts, in a cache by their sha256, checked on arrival.

    <cache>/parts/ab/ab12….zip             archives of parts, whatever dataset names them
    <cache>/remote/DIGEST/                 manifest and tables of a dataset, by the digest of its manifest
    <cache>/remote/addresses/KEY           digest of the manifest that an address named last

A file appears under its name by one rename, complete and checked. The oldest archives make room for new ones
below TCMRL_CACHE_LIMIT; a process that reads one which is removed keeps it open.
"""

import contextlib
import functools
import os
import threading
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path

from tcmrl_data.foundation.disk import (
    STAGING,
    disk,
    make_folders,
    move_into_place,
    named_errors,
    remove_tree,
    replace_file,
    write_file,
)
from tcmrl_data.foundation.errors import ManifestError, RemoteError
from tcmrl_data.foundation.files import read_plain_file
from tcmrl_data.foundation.machine import cache_folder, cache_limit
from tcmrl_data.foundation.records import sha256
from tcmrl_data.remote.address import Address
from tcmrl_data.remote.objects import Objects, each
from tcmrl_data.remote.published import read_published
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.manifest import MANIFEST, Manifest, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry
from tcmrl_data.store.tables import TASKS, part_file

Progress = Callable[[int, int], None]
"""Takes the number of bytes that are there, and of all."""

ROOM = "make room on the disk, or set TCMRL_CACHE to a folder on a larger one"


LARGEST_TABLE = 2**31
"""Bytes of a table that are fetched at most; a million parts take a fifth."""


def is_offline() -> bool:
    """Whether TCMRL_OFFLINE asks to use what the cache holds, and no network."""
    return os.environ.get("TCMRL_OFFLINE", "0") not in ("", "0")


class RemoteFiles:
    """The files of a dataset at an address; made by `open_remote`.

    Attributes:
        address: where the dataset lies.
        folder: in the cache, with its manifest and tables.
    """

    def __init__(self, address: Address, folder: Path) -> None:
        self.address, self.folder = address, folder
        self._room = 0

    @functools.cached_property
    def _objects(self) -> Objects:
        return Objects(Address(self.address.protocol, self.address.place, _revision(self.address)))

    def __reduce__(self) -> tuple[type["RemoteFiles"], tuple[Address, Path]]:
        return RemoteFiles, (self.address, self.folder)

    def file(self, entry: PartEntry) -> Path:
        """The archive of a part in the cache, fetched if it is not there.

        Raises:
            RemoteError: it is not there and cannot be fetched.
            StorageError: the cache cannot be written.
        """
        file = _cached(entry)
        if not _is_there(file, entry):
            self._make_room([entry])
            self._fetch(entry, None)
        return file

    def fetch(self, entries: Iterable[PartEntry], progress: Progress | None = None) -> None:
        """Brings archives of parts into the cache, several at a time; errors as of `file`."""
        wanted = list(entries)
        missing = [entry for entry in wanted if not _is_there(_cached(entry), entry)]
        if not missing:
            return
        self._make_room(missing, wanted)
        say = counted(progress, sum(entry.size for entry in missing))
        each(lambda entry: self._fetch(entry, say), missing)

    def _fetch(self, entry: PartEntry, say: Callable[[int], None] | None) -> None:
        if is_offline():
            name = part_file(entry.key)
            raise RemoteError(f"{self.address.base}/{name} is not in the cache; unset TCMRL_OFFLINE")
        self.copy(entry, _cached(entry), staging=_staging(), say=say)

    def copy(
        self, entry: PartEntry, file: Path, *, staging: Path, say: Callable[[int], None] | None = None
    ) -> None:
        """Fetches a part into a file, which appears once it is complete and checked; errors as of `file`."""
        if entry.size > LARGEST_ARCHIVE:
            raise ManifestError(
                f"{self.address}: {entry.key} would have {entry.size} bytes; no part has as many"
            )
        make_folders(staging)
        make_folders(file.parent)
        staged = staging / f"{file.name}.{uuid.uuid4().hex}"
        try:
            self._objects.fetch(part_file(entry.key), staged, limit=entry.size, sha256=entry.sha256, say=say)
            with named_errors(file, remedy=ROOM):
                disk.sync(staged)
                disk.rename(staged, file)
        finally:
            staged.unlink(missing_ok=True)

    def _make_room(self, missing: list[PartEntry], wanted: Iterable[PartEntry] = ()) -> None:
        """Removes the archives that were used least recently, so that new ones fit."""
        self._room -= sum(entry.size for entry in missing)
        if self._room >= 0:
            return
        kept = {_cached(entry) for entry in wanted}
        files = [(file, file.stat()) for file in (cache_folder() / "parts").glob("*/*.zip")]
        needed = sum(entry.size for entry in missing)
        self._room = cache_limit() - needed - sum(status.st_size for _, status in files)
        for file, status in sorted(files, key=lambda item: item[1].st_mtime):
            if self._room >= 0:
                return
            if file not in kept:
                file.unlink(missing_ok=True)
                self._room += status.st_size


def open_remote(address: Address) -> tuple[RemoteFiles, Manifest]:
    """Reads manifest and tables of a dataset into the cache, unless they are there.

    Raises:
        RemoteError: there is no dataset at the address, or the server does not give it.
        ManifestError: manifest or tables are damaged, or of another version.
        StorageError: the cache cannot be written.
    """
    cache = cache_folder() / "remote"
    known = cache / "addresses" / sha256(str(address).encode())
    if is_offline():
        try:
            folder = cache / read_plain_file(known, limit=64).decode()
        except (OSError, ValueError):
            raise RemoteError(f"{address} is not in the cache; unset TCMRL_OFFLINE") from None
        return RemoteFiles(address, folder), read_manifest(folder)
    objects, staging = Objects(address), _staging() / uuid.uuid4().hex
    found = read_published(objects)
    folder = cache / found.manifest.digest
    if not folder.is_dir():
        make_folders(staging)
        try:
            fetch_tables(objects, found.manifest, found.prefix, staging)
            write_file(staging / MANIFEST, found.data)
            with named_errors(staging):
                for name in (TASKS, PARTS_TABLE):
                    disk.sync(staging / name)
                disk.sync(staging)
            move_into_place(staging, folder)
        finally:
            remove_tree(staging)
    if not known.is_file() or known.read_text() != found.manifest.digest:
        replace_file(known, found.manifest.digest.encode())
    return RemoteFiles(address, folder), found.manifest


def fetch_tables(objects: Objects, manifest: Manifest, prefix: str, folder: Path) -> None:
    """Writes the sealed lines of both tables into a folder; errors as of `open_remote`."""
    for name, seal in ((TASKS, manifest.tasks), (PARTS_TABLE, manifest.parts)):
        if seal.bytes > LARGEST_TABLE:
            raise ManifestError(
                f"{objects.address}: {name} would have {seal.bytes} bytes, at most {LARGEST_TABLE} are read"
            )
        objects.fetch(prefix + name, folder / name, limit=seal.bytes, sha256=seal.sha256, prefix=True)


def clear_fetched() -> int:
    """Removes from the cache what was fetched from addresses; returns how many bytes that were.

    Raises:
        StorageError: the cache cannot be written.
    """
    removed = 0
    with named_errors(cache_folder(), remedy="give write access to the cache"):
        for file in [path for name in ("parts", "remote") for path in (cache_folder() / name).rglob("*")]:
            if file.is_file():
                removed += file.stat().st_size
                file.unlink(missing_ok=True)
    for name in ("parts", "remote"):
        remove_tree(cache_folder() / name)
    return removed


def counted(progress: Progress | None, total: int, done: int = 0) -> Callable[[int], None]:
    """A function that adds up bytes and tells a progress of them."""
    so_far, lock = done, threading.Lock()

    def say(more: int) -> None:
        nonlocal so_far
        with lock:
            so_far += more
            if progress:
                progress(so_far, total)

    return say


def _staging() -> Path:
    return cache_folder() / "remote" / STAGING


def _revision(address: Address) -> str | None:
    """The Hub has the parts of a tag under the tag; all others have them above."""
    return address.tag if address.protocol == "hf" else None


def _cached(entry: PartEntry) -> Path:
    return cache_folder() / "parts" / entry.sha256[:2] / f"{entry.sha256}.zip"


def _is_there(file: Path, entry: PartEntry) -> bool:
    try:
        is_whole = file.stat().st_size == entry.size
    except OSError:
        return False
    with contextlib.suppress(OSError):  # a cache that may only be read
        os.utime(file)
    return is_whole
