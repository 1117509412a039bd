"""Removing files that builds leave behind, and whole datasets, and nothing else that lies beside them."""

import contextlib
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.behavior.base import checkpoint_tasks
from tcmrl_data.building.work_files import (
    ASSEMBLY,
    CROISSANT_FILES,
    TABLES,
    WORK_FILES,
    WORK_FOLDERS,
    check_work_files,
    is_viewer_file,
)
from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.disk import (
    CHECKPOINTS,
    LOCK,
    STAGING,
    abandoned,
    disk,
    lock_file,
    lock_holder,
    named_errors,
    remove_abandoned,
    remove_tree,
)
from tcmrl_data.foundation.errors import BuildError, LockedError, StoreError
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, dataset_folder, read_manifest
from tcmrl_data.store.tables import PARTS, is_part_folder, key_of_file
from tcmrl_data.verification.description import Scan, scan_dataset


@dataclass(frozen=True)
class Garbage:
    """One thing to remove, its path relative to the dataset, and the size of all its files."""

    path: str
    reason: str
    bytes: int


def collect_garbage(path: str | Path, *, dry_run: bool = False) -> tuple[Garbage, ...]:
    """Removes abandoned staging, and checkpoints of units all of whose tasks have all parts published.

    Args:
        dry_run: only return what would be removed; change nothing.

    Raises:
        BuildError: there is no dataset at the path, or its work folders are links.
        LockedError: a process works on the dataset; names it.
        ManifestError: the manifest is damaged, so that the finished tasks are unknown.
    """
    folder = dataset_folder(path)
    if not any((folder / name).exists() for name in (MANIFEST, LOCK, STAGING)):
        raise BuildError(f"{folder} holds no dataset; build one with `tcmrl-data build ENV`")
    with _idle(folder, dry_run=dry_run):
        found = _garbage(folder)
        if not dry_run:
            remove_abandoned(folder)
            for item in found:
                if item.path.startswith(CHECKPOINTS):
                    remove_tree(folder / item.path)
    return found


@contextlib.contextmanager
def _idle(folder: Path, *, dry_run: bool) -> Iterator[None]:
    """Holds the lock of a dataset; a dry run, which writes no lock file, only asks for its holder."""
    check_work_files(folder)
    if not dry_run:
        with lock_file(folder / LOCK, f"dataset {folder}"):
            yield
        return
    holder = lock_holder(folder / LOCK)
    if holder is not None:
        raise LockedError(f"dataset {folder} is being written by {holder}; wait for it or stop it")
    yield


def _garbage(folder: Path) -> tuple[Garbage, ...]:
    checkpoints = folder / CHECKPOINTS
    found = [
        Garbage(f"{STAGING}/{path.name}", "abandoned by a build that ended", _size(path))
        for path in abandoned(folder)
    ]
    is_done = _done_tasks(folder)
    for path in sorted(checkpoints.iterdir()) if checkpoints.is_dir() else []:
        tasks = checkpoint_tasks(path.name)
        if (
            tasks
            and {tasks[0], tasks[-1]} <= set(is_done)
            and all(done for index, done in is_done.items() if index in tasks)
        ):
            reason = f"task {tasks[0]} is" if len(tasks) == 1 else f"tasks {tasks[0]} to {tasks[-1]} are"
            found.append(Garbage(f"{CHECKPOINTS}/{path.name}", f"{reason} done", _size(path)))
    return tuple(found)


def _done_tasks(folder: Path) -> dict[int, bool]:
    """Whether every part of a task is in the manifest, by index; empty where there is no manifest yet."""
    if not (folder / MANIFEST).exists():
        return {}
    dataset = Dataset(folder, read_manifest(folder))
    dropped = set(dataset.manifest.dropped)
    return {
        task.index: task.index in dropped or not dataset.missing(task.index)
        for task in dataset.recorded_tasks
    }


def _size(path: Path) -> int:
    files = [path, *path.rglob("*")] if path.is_dir() and not path.is_symlink() else [path]
    return sum(file.lstat().st_size for file in files if not file.is_dir())


NO_REMEDY = "delete the folder yourself if it is to go"


@dataclass(frozen=True)
class Deletion:
    """What a deletion removed, or would remove.

    Attributes:
        files: number of files, without work files.
        kept: files that are no part of a dataset, relative to the folder; they stay, and so does the folder.
    """

    dataset: Path
    files: int
    bytes: int
    kept: tuple[str, ...]


def delete_dataset(path: str | Path, *, dry_run: bool = False) -> Deletion:
    """Deletes a dataset, or what a stopped build or derivation left of one.

    The manifest goes first, so that an interrupted deletion leaves no dataset that lacks parts; the same call
    goes on. Files that are no part of a dataset stay and are named.

    Raises:
        StoreError: there is no dataset at the path, or the path is a link or a view.
        ManifestError: the manifest is damaged, so that it is not sure that this is a dataset.
        LockedError: a process works on the dataset; names it.
        BuildError: its work files are links.

    Example:
        >>> delete_dataset("data/point-robot-medium", dry_run=True)  # doctest: +SKIP
    """
    folder = dataset_folder(path)
    if folder.is_symlink() or not folder.is_dir():
        kind = "a link" if folder.is_symlink() else "a file" if folder.exists() else "not there"
        raise StoreError(f"{folder} is {kind}, not the folder of a dataset; {NO_REMEDY}")
    if (folder / MANIFEST).exists():
        read_manifest(folder)
    elif not any((folder / name).exists() for name in (PARTS, ASSEMBLY)):
        raise StoreError(f"{folder} holds no dataset; {NO_REMEDY}")
    with _idle(folder, dry_run=dry_run), named_errors(folder):
        scan = scan_dataset(folder, follow=False)
        if not dry_run:
            _remove(folder, scan)
    own = [status.st_size for file, status in scan.files.items() if _is_own(file, status.st_mode)]
    kept = [file for file, status in scan.files.items() if not _is_own(file, status.st_mode)]
    return Deletion(folder, len(own), sum(own), tuple(sorted([*kept, *scan.problems, *scan.hidden])))


def _is_own(file: str, mode: int) -> bool:
    """Whether a file is one that a dataset has: a plain file of such a name, or a link in its place."""
    if stat.S_ISLNK(mode) and is_part_folder(file):
        return True
    return stat.S_IFMT(mode) in (stat.S_IFREG, stat.S_IFLNK) and (
        file in {MANIFEST, *TABLES, *CROISSANT_FILES} or is_viewer_file(file) or key_of_file(file) is not None
    )


def _remove(folder: Path, scan: Scan) -> None:
    (folder / MANIFEST_COPY).unlink(missing_ok=True)
    if MANIFEST in scan.files:
        (folder / MANIFEST).unlink()
        disk.sync(folder)
    for name in WORK_FOLDERS:
        remove_tree(folder / name)
    own = [folder / file for file, status in scan.files.items() if _is_own(file, status.st_mode)]
    for file in own:
        file.unlink(missing_ok=True)
    _remove_empty({parent for file in own for parent in file.parents if folder in parent.parents})
    _remove_empty(folder / place for place in scan.empty_folders if place.startswith(f"{PARTS}"))
    for name in WORK_FILES:
        (folder / name).unlink(missing_ok=True)
    _remove_empty([folder])


def _remove_empty(folders: Iterable[Path]) -> None:
    for folder in sorted(folders, reverse=True):
        with contextlib.suppress(OSError):
            folder.rmdir()
