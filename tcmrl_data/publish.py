"""Every file operation that matters: staging, fsync, rename, lock, gc."""

import contextlib
import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from tcmrl_data.errors import LockedError

STAGING = ".staging"
LOCK = ".lock"


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


def sync_tree(path: Path) -> None:
    """Forces every file and folder below and including `path` to disk."""
    for folder, _, files in os.walk(path, topdown=False):
        for name in files:
            descriptor = os.open(os.path.join(folder, name), os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(folder))


def replace_file(dataset: Path, name: str, data: bytes) -> None:
    """Puts `data` under dataset/name in one step: readers see the old file or the new one."""
    staging = dataset / STAGING
    staging.mkdir(exist_ok=True)
    temporary = staging / f"{name}.{uuid.uuid4().hex}"
    write_file(temporary, data)
    os.replace(temporary, dataset / name)
    sync_folder(dataset)


def publish_folder(staged: Path, target: Path) -> bool:
    """Renames a synced staged folder to its final place; False where a folder stands there already."""
    try:
        os.rename(staged, target)
    except OSError:
        if target.is_dir():
            return False
        raise
    sync_folder(target.parent)
    return True


@contextlib.contextmanager
def stage(dataset: Path, unit: str) -> Iterator[Path]:
    """A folder of this attempt under its own lock; removed at the end unless it was published."""
    staging = dataset / STAGING
    staging.mkdir(exist_ok=True)
    attempt = staging / f"{unit}.{uuid.uuid4().hex}"
    with lock_file(attempt.with_name(f"{attempt.name}.lock"), "this attempt") as lock:
        attempt.mkdir()
        try:
            yield attempt
        finally:
            shutil.rmtree(attempt, ignore_errors=True)
            lock.unlink(missing_ok=True)


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
