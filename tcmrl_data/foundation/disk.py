"""File operations that survive a crash: staging, fsync, rename and locks."""

import contextlib
import errno
import os
import shutil
import stat
import sys
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any, TextIO

from tcmrl_data.foundation.errors import LockedError, ReadOnlyError, StorageError
from tcmrl_data.foundation.files import is_locked, open_plain_file, try_exclusive_lock

STAGING = ".staging"
LOCK = ".lock"
CHECKPOINTS = ".checkpoints"

SYNCS = 16
"""Files that are forced to disk side by side; a disk makes several durable in the time of one."""

GO_ON = "make room on the disk or repair it, then run the same command again to continue"


class Disk:
    """Operations that change a disk; tests replace it by one that fails or loses data."""

    def make_folder(self, path: Path) -> None:
        """Creates one folder."""
        path.mkdir()

    def write(self, path: Path, data: bytes) -> None:
        """Writes a new file without forcing it to disk."""
        with path.open("xb") as file:
            file.write(data)

    def write_at(self, path: Path, offset: int, data: bytes) -> None:
        """Writes into a file, which is created if it does not exist, without forcing it to disk."""
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        with os.fdopen(descriptor, "wb") as file:
            file.seek(offset)
            file.write(data)

    def truncate(self, path: Path, size: int) -> None:
        """Cuts off what a file holds behind its first `size` bytes, without forcing it to disk."""
        os.truncate(path, size)

    def sync(self, path: Path) -> None:
        """Forces a file's content, or a folder's entries, to disk."""
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        """Replaces a file, or moves a folder to a path that is free or an empty folder, atomically."""
        os.replace(source, target)


disk = Disk()


def write_file(path: Path, data: bytes) -> None:
    """Writes a new file and forces its content, not its name, to disk."""
    with named_errors(path):
        disk.write(path, data)
        disk.sync(path)


def make_folders(path: Path) -> None:
    """Creates a folder and its parents, and forces their names to disk."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    with named_errors(path):
        for folder in reversed(missing):
            with contextlib.suppress(FileExistsError):  # another worker may have created it meanwhile
                disk.make_folder(folder)
            disk.sync(folder.parent)


def _make_staging(path: Path) -> None:
    """Creates the staging folder; not forced to disk, since a crash may lose its content."""
    if not path.is_dir():
        with named_errors(path), contextlib.suppress(FileExistsError):
            disk.make_folder(path)


def replace_file(path: Path, data: bytes, *, staging: Path | None = None) -> None:
    """Replaces a file atomically: readers see the old content or the new content.

    A link in its place is replaced, not followed, and another name of the old file keeps the old content.

    Args:
        staging: folder for the unfinished file; None, or a folder on another disk than the file's, writes a
            hidden file next to `path`.
    """
    name = f"{path.name}.{uuid.uuid4().hex}"
    places = [path.with_name(f".{name}")]
    if staging is not None:
        _make_staging(staging)
        places.insert(0, staging / name)
    make_folders(path.parent)
    with named_errors(path):
        for temporary in places:
            try:
                disk.write(temporary, data)
                disk.sync(temporary)
                disk.rename(temporary, path)
                break
            except OSError as error:
                if error.errno != errno.EXDEV or temporary is places[-1]:
                    raise
            finally:
                temporary.unlink(missing_ok=True)
        disk.sync(path.parent)


def make_own(path: Path, *, num_bytes: int, staging: Path) -> None:
    """Replaces a file by a copy of its first bytes if it is a link, or has other names (hard links).

    What is then written into it changes no other file. A link to nothing is removed.
    """
    with named_errors(path):
        try:
            status = path.lstat()
        except FileNotFoundError:
            return
        if not stat.S_ISLNK(status.st_mode) and status.st_nlink == 1:
            return
        if not path.exists():
            path.unlink()
            return
        with open_plain_file(path, limit=sys.maxsize) as shared:
            data = shared.read(num_bytes)
        replace_file(path, data, staging=staging)


def place_file(path: Path, data: bytes, *, staging: Path) -> None:
    """Writes a file for a folder that nobody reads yet; `sync_files` makes it durable, with many others.

    Other processes see the whole file or none. A crash of the machine may leave anything of it, so whoever
    goes on after a crash must check its content.

    Args:
        staging: folder for the unfinished file; it exists.
    """
    temporary = staging / f"{path.name}.{uuid.uuid4().hex}"
    with named_errors(path):
        for folder in [] if path.parent.exists() else reversed([path.parent, *path.parent.parents]):
            if not folder.exists():
                with contextlib.suppress(FileExistsError):  # another thread may have created it meanwhile
                    disk.make_folder(folder)
        try:
            disk.write(temporary, data)
            disk.rename(temporary, path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise


def sync_files(root: Path, files: Iterable[Path]) -> None:
    """Forces files below a folder to disk: first their contents, then their names and their folders'."""
    files = list(files)
    parents = {file.parent for file in files}
    folders = {
        place for folder in parents for place in (folder, *folder.parents) if root in (place, *place.parents)
    }
    with named_errors(root), ThreadPoolExecutor(SYNCS) as pool:
        list(pool.map(disk.sync, files))
        list(pool.map(disk.sync, sorted(folders)))


def remove_tree(folder: Path) -> None:
    """Removes a folder and its content, if it exists."""
    shutil.rmtree(folder, ignore_errors=True)


def publish_folder(root: Path, target: Path, files: Mapping[str, bytes], *, attempt: str) -> bool:
    """Publishes a folder with the given files at `target` atomically.

    Args:
        root: folder whose staging area is used, such as a dataset's.

    Returns:
        False if `target` already exists; nothing is changed then.
    """
    staging = root / STAGING
    _make_staging(staging)
    staged = staging / f"{attempt}.{uuid.uuid4().hex}"
    with lock_file(_attempt_lock(staged), "this attempt") as lock:
        try:
            folders = {staged, *(staged / parent for name in files for parent in Path(name).parents)}
            with named_errors(staged):
                for path in sorted(folders):
                    disk.make_folder(path)
                for name, data in files.items():
                    write_file(staged / name, data)
                for path in sorted(folders, reverse=True):
                    disk.sync(path)
            return move_into_place(staged, target)
        finally:
            remove_tree(staged)
            lock.unlink(missing_ok=True)


def move_into_place(staged: Path, target: Path) -> bool:
    """Renames a synced folder to its final path; returns False if a non-empty folder is already there."""
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
    """Turns an `OSError` into an error that names the path and a remedy.

    Raises:
        StorageError: the operating system refuses an operation within the block.
    """
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            remedy = "give yourself the right to write there, or choose another place"
        raise StorageError(f"cannot write {path}: {reason}; {remedy}") from None


def require_room(file: Path, num_bytes: int, *, remedy: str = GO_ON) -> None:
    """Checks that a file can grow, or be created, for libraries that fail badly on a full disk.

    The bytes are reserved briefly in an unnamed file, so that quotas and file size limits are checked too.
    """
    with named_errors(file, remedy=remedy), tempfile.TemporaryFile(dir=file.parent) as scratch:
        size = file.stat().st_size if file.exists() else 0
        os.posix_fallocate(scratch.fileno(), size, num_bytes)


@contextlib.contextmanager
def lock_file(path: Path, what: str) -> Iterator[Path]:
    """Holds an exclusive lock on a file that names its holder.

    A link in its place is removed. A file with other names, as in a copy made of hard links, is locked as
    one file in all places; where nobody holds it, this place gets a file of its own.

    Raises:
        LockedError: another process holds the lock; the message names that process.
        ReadOnlyError: the folder cannot be written.
    """
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(_open_lock(path))
        with named_errors(path, remedy="choose a folder on a file system with locks"):
            is_ours = try_exclusive_lock(file)
        if not is_ours:
            raise LockedError(f"{what} is being written by {_holder(file)}; wait for it or stop it")
        has_one_name = os.fstat(file.fileno()).st_nlink == 1
        if not has_one_name or not is_current(file, path):  # or its last holder removed it meanwhile
            if is_current(file, path):
                path.unlink()
            stack.close()
            stack.enter_context(lock_file(path, what))
        else:
            file.truncate(0)
            file.write(f"process {os.getpid()} on {os.uname().nodename}")
            file.flush()
        yield path


def is_current(file: IO[Any], path: Path) -> bool:
    """Whether the path still refers to the open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _open_lock(path: Path) -> TextIO:
    try:
        if path.is_symlink():  # that of a stranger's dataset may lead anywhere
            path.unlink()
        return open(path, "a+", opener=_open_no_link)
    except OSError as error:
        if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise
        raise ReadOnlyError(
            f"{path.parent} cannot be written ({error.strerror}); use a copy that can"
        ) from None


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def lock_holder(path: Path) -> str | None:
    """The process that holds the lock of `lock_file`, or None if no process does.

    Asking takes no lock, so that it may be done at any time; the file may be read-only.
    """
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return None
        with open(path, "rb", opener=_open_no_link) as file:
            return _holder(file) if is_locked(file) else None
    except (FileNotFoundError, NotADirectoryError):  # removed meanwhile, or never there
        return None


def _holder(file: IO[Any]) -> str:
    """The process that a lock file names; its path may name another file by now, or none."""
    return os.pread(file.fileno(), 200, 0).decode(errors="replace").strip() or "another process"


def abandoned(root: Path) -> list[Path]:
    """What processes that have ended left in the staging folder; the locks of attempts go with them.

    A process creates an attempt after the attempt's lock and removes it before the lock, so an attempt
    without a lock is abandoned. A single staged file belongs to the caller, who must be the only writer, or
    to a worker whose driver has ended.
    """
    staging = root / STAGING
    found = []
    for path in sorted(staging.iterdir()) if staging.is_dir() else []:
        is_lock = path.suffix == ".lock"
        if lock_holder(path if is_lock else _attempt_lock(path)) is None:
            found += [] if is_lock and path.with_suffix("").exists() else [path]
    return found


def remove_abandoned(root: Path) -> None:
    """Removes what is abandoned in the staging folder."""
    for path in abandoned(root):
        if path.is_dir():
            remove_tree(path)
        elif path.suffix != ".lock":
            path.unlink(missing_ok=True)  # its owner may have removed it meanwhile
        lock = path if path.suffix == ".lock" else _attempt_lock(path)
        if lock.exists():
            with contextlib.suppress(LockedError), lock_file(lock, lock.name):
                lock.unlink()


def _attempt_lock(path: Path) -> Path:
    return path.with_name(f"{path.name}.lock")
