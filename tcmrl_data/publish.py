"""Every file operation that matters: staging, fsync, rename, lock, gc."""

import contextlib
import errno
import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path

from tcmrl_data.errors import LockedError

STAGING = ".staging"
LOCK = ".lock"
CHECKPOINTS = ".checkpoints"


def write_file(path: Path, data: bytes) -> None:
    """Writes a new file and forces it to disk."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Forces a folder's entries to disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_tree(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes files (relative path to content) into a new folder and forces all of it to disk."""
    folder.mkdir()
    folders = {folder}
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, data)
        folders.update(parent for parent in path.parents if folder in parent.parents)
    for each in sorted(folders, reverse=True):
        sync_folder(each)


def sync_tree(folder: Path) -> None:
    """Forces everything below and including a folder to disk, for files that a library wrote."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    for each in sorted([path for path in folder.rglob("*") if path.is_dir()], reverse=True):
        sync_folder(each)
    sync_folder(folder)


def replace_file(folder: Path, name: str, data: bytes, *, staging: Path) -> None:
    """Puts `data` under folder/name in one step: readers see the old file or the new one."""
    staging.mkdir(exist_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    temporary = staging / f"{name}.{uuid.uuid4().hex}"
    write_file(temporary, data)
    os.replace(temporary, folder / name)
    sync_folder(folder)


def remove_tree(folder: Path) -> None:
    """Removes a folder and all it holds, if it is there."""
    shutil.rmtree(folder, ignore_errors=True)


def publish_folder(dataset: Path, target: Path, files: Mapping[str, bytes], *, attempt: str) -> bool:
    """Makes a folder with the given files appear at `target` in one step.

    Args:
        dataset: folder whose staging area is used.
        target: final place inside the dataset; its parent exists.
        files: relative path to content.
        attempt: names the staging folder, for people who look.

    Returns:
        False where a folder stands at `target` already; nothing is changed then.
    """
    staging = dataset / STAGING
    staging.mkdir(exist_ok=True)
    staged = staging / f"{attempt}.{uuid.uuid4().hex}"
    with lock_file(staged.with_name(f"{staged.name}.lock"), "this attempt") as lock:
        try:
            write_tree(staged, files)
            return move_into_place(staged, target)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
            lock.unlink(missing_ok=True)


def move_into_place(staged: Path, target: Path) -> bool:
    """Renames a synced folder to its final place; False where a folder that is not empty stands there."""
    try:
        os.rename(staged, target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    sync_folder(target.parent)
    return True


@contextlib.contextmanager
def lock_file(path: Path, what: str) -> Iterator[Path]:
    """Holds an exclusive lock on a file that names its holder.

    Raises:
        LockedError: another process holds it; the message names that process.
    """
    with path.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise LockedError(f"{what} is being written by {holder}; wait for it or stop it") from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {os.uname().nodename}")
        file.flush()
        yield path


def remove_abandoned(dataset: Path) -> list[str]:
    """Removes staging whose lock can be taken, that is, whose owner is gone; returns what was removed."""
    staging = dataset / STAGING
    removed = []
    for lock in sorted(staging.glob("*.lock")) if staging.is_dir() else []:
        with contextlib.suppress(LockedError), lock_file(lock, lock.name):
            shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
            lock.unlink()
            removed.append(lock.stem)
    for file in sorted(staging.glob("manifest.json.*")) if staging.is_dir() else []:
        file.unlink()  # only the driver writes these, and the caller holds the driver's lock
        removed.append(file.name)
    return removed
