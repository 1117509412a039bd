"""Every file operation that matters: staging, fsync, rename, lock, gc."""

import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TextIO

from tcmrl_data.foundation.errors import LockedError, ReadOnlyError, StorageError

STAGING = ".staging"
LOCK = ".lock"
CHECKPOINTS = ".checkpoints"

GO_ON = "make room on the disk or mend it, then run the same command again to go on"


class Disk:
    """The operations that change what a disk holds; tests put one in its place that fails or forgets."""

    def make_folder(self, path: Path) -> None:
        """Makes one folder."""
        path.mkdir()

    def write(self, path: Path, data: bytes) -> None:
        """Writes a new file; not forced to disk."""
        with path.open("xb") as file:
            file.write(data)

    def sync(self, path: Path) -> None:
        """Forces a file's content, or a folder's entries, to disk."""
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        """Moves a file over another one, or a folder into an empty place, in one step."""
        os.replace(source, target)


disk = Disk()


def write_file(path: Path, data: bytes) -> None:
    """Writes a new file and forces its content, not its name, to disk.

    Raises:
        StorageError: the disk refuses.
    """
    with named_errors(path):
        disk.write(path, data)
        disk.sync(path)


def make_folders(path: Path) -> None:
    """Makes a folder and its parents, each name forced to disk."""
    missing = [each for each in (path, *path.parents) if not each.exists()]
    with named_errors(path):
        for each in reversed(missing):
            with contextlib.suppress(FileExistsError):  # another worker may have made it meanwhile
                disk.make_folder(each)
            disk.sync(each.parent)


def _make_staging(path: Path) -> None:
    """Makes the staging folder; its name may be lost, since nothing in it is meant to last."""
    if not path.is_dir():
        with named_errors(path), contextlib.suppress(FileExistsError):
            disk.make_folder(path)


def write_tree(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes files (relative path to content) into a new folder and forces all of it to disk.

    Raises:
        StorageError: the disk refuses.
    """
    folders = {folder, *(folder / each for name in files for each in Path(name).parents)}
    with named_errors(folder):
        for each in sorted(folders):
            disk.make_folder(each)
        for name, data in files.items():
            write_file(folder / name, data)
        for each in sorted(folders, reverse=True):
            disk.sync(each)


def sync_tree(folder: Path) -> None:
    """Forces everything below and including a folder to disk, for files that a library wrote."""
    for each in sorted([folder, *folder.rglob("*")], reverse=True):
        disk.sync(each)


def replace_file(path: Path, data: bytes, *, staging: Path | None = None) -> None:
    """Puts `data` at a path in one step: readers see the old file or the new one.

    Args:
        path: the file; folders above it are made.
        data: its content.
        staging: folder for the unfinished file; it lies beside the file, hidden, where None.

    Raises:
        StorageError: the disk refuses; the old file stands.
    """
    if staging is not None:
        _make_staging(staging)
    make_folders(path.parent)
    temporary = (staging or path.parent) / f"{'' if staging else '.'}{path.name}.{uuid.uuid4().hex}"
    with named_errors(path):
        try:
            write_file(temporary, data)
            disk.rename(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        disk.sync(path.parent)


def remove_tree(folder: Path) -> None:
    """Removes a folder and all it holds, if it is there."""
    shutil.rmtree(folder, ignore_errors=True)


def publish_folder(root: Path, target: Path, files: Mapping[str, bytes], *, attempt: str) -> bool:
    """Makes a folder with the given files appear at `target` in one step.

    Args:
        root: folder whose staging area is used, such as a dataset's.
        target: final place inside it; its parent exists.
        files: relative path to content.
        attempt: names the staging folder, for people who look.

    Returns:
        False where a folder stands at `target` already; nothing is changed then.

    Raises:
        StorageError: the disk refuses; nothing is published.
    """
    staging = root / STAGING
    _make_staging(staging)
    staged = staging / f"{attempt}.{uuid.uuid4().hex}"
    with lock_file(staged.with_name(f"{staged.name}.lock"), "this attempt") as lock:
        try:
            write_tree(staged, files)
            return move_into_place(staged, target)
        finally:
            remove_tree(staged)
            lock.unlink(missing_ok=True)


def move_into_place(staged: Path, target: Path) -> bool:
    """Renames a synced folder to its final place; False where a folder that is not empty stands there.

    Raises:
        StorageError: the disk refuses.
    """
    with named_errors(target):
        try:
            disk.rename(staged, target)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                return False
            raise
        disk.sync(target.parent)
    return True


@contextlib.contextmanager
def named_errors(path: Path, *, remedy: str = GO_ON) -> Iterator[None]:
    """Turns what the operating system reports into an error that names the path and a remedy.

    Raises:
        StorageError: the disk refuses.
    """
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise StorageError(f"cannot write {path}: {reason}; {remedy}") from None


def require_room(file: Path, num_bytes: int, *, remedy: str = GO_ON) -> None:
    """Checks that a file can grow, or be made, before a library writes it that fails badly if it cannot.

    The bytes are reserved for a moment in an unnamed file, so that quotas and limits of a file's size count.

    Args:
        file: its folder exists.
        num_bytes: by how much it grows.
        remedy: ends the error's text.

    Raises:
        StorageError: the disk refuses.
    """
    with named_errors(file, remedy=remedy), tempfile.TemporaryFile(dir=file.parent) as scratch:
        size = file.stat().st_size if file.exists() else 0
        os.posix_fallocate(scratch.fileno(), size, num_bytes)


@contextlib.contextmanager
def lock_file(path: Path, what: str) -> Iterator[Path]:
    """Holds an exclusive lock on a file that names its holder.

    Raises:
        LockedError: another process holds it; the message names that process.
        ReadOnlyError: the folder cannot be written.
    """
    with _open_lock(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LockedError(f"{what} is being written by {_holder(path)}; wait for it or stop it") from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {os.uname().nodename}")
        file.flush()
        yield path


def _open_lock(path: Path) -> TextIO:
    try:
        return path.open("a+")
    except OSError as error:
        if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise
        raise ReadOnlyError(
            f"{path.parent} cannot be written ({error.strerror}); use a copy that can"
        ) from None


def lock_holder(path: Path) -> str | None:
    """The process that holds a lock, or None where nobody does."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return _holder(path)
    return None


def _holder(path: Path) -> str:
    return path.read_text(errors="replace").strip()[:200] or "another process"


def remove_abandoned(root: Path) -> list[str]:
    """Removes staging whose owner is gone; returns what was removed. The caller is the only writer.

    An attempt is made after its lock and removed before it, so what has no lock has no owner; and files on
    their way to their place belong to the lock's holder, or to a worker whose driver is gone.
    """
    staging = root / STAGING
    removed = []
    for lock in sorted(staging.glob("*.lock")) if staging.is_dir() else []:
        with contextlib.suppress(LockedError), lock_file(lock, lock.name):
            remove_tree(lock.with_suffix(""))
            lock.unlink()
            removed.append(lock.stem)
    for path in sorted(staging.iterdir()) if staging.is_dir() else []:
        if path.suffix == ".lock" or path.with_name(f"{path.name}.lock").exists():
            continue
        if path.is_dir():
            remove_tree(path)
        else:
            path.unlink()
        removed.append(path.name)
    return removed
