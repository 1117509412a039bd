"""Removal of files that builds no longer need: abandoned staging and checkpoints of finished units."""

from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.work_files import check_work_files, checkpoint_tasks
from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.disk import (
    CHECKPOINTS,
    LOCK,
    STAGING,
    lock_file,
    lock_holder,
    remove_abandoned,
    remove_tree,
)
from tcmrl_data.foundation.errors import BuildError, LockedError
from tcmrl_data.store.manifest import MANIFEST, dataset_folder, read_manifest
from tcmrl_data.verification.repair import REPAIR


@dataclass(frozen=True)
class Garbage:
    """One thing to remove.

    Attributes:
        path: relative to the dataset.
        reason: why it is not needed.
        bytes: size of all its files.
    """

    path: str
    reason: str
    bytes: int


def collect_garbage(path: str | Path, *, dry_run: bool = False) -> tuple[Garbage, ...]:
    """Removes abandoned staging, and checkpoints of units all of whose tasks have all parts published.

    Args:
        path: the dataset's folder or its `manifest.json`.
        dry_run: only return what would be removed; change nothing.

    Raises:
        BuildError: there is no dataset at the path, or its work folders are links.
        LockedError: a process works on the dataset; names it.
        ManifestError: the manifest is damaged, so that the finished tasks are unknown.
    """
    folder = dataset_folder(path)
    if not any((folder / name).exists() for name in (MANIFEST, LOCK, STAGING)):
        raise BuildError(f"{folder} holds no dataset; build one with `tcmrl-data build ENV`")
    check_work_files(folder)
    holder = lock_holder(folder / LOCK)
    if holder is not None:
        raise LockedError(f"dataset {folder} is being written by {holder}; wait for it or stop it")
    if dry_run:
        return _garbage(folder)
    with lock_file(folder / LOCK, f"dataset {folder}"):
        found = _garbage(folder)
        remove_abandoned(folder)
        for item in found:
            if item.path.startswith(CHECKPOINTS) or item.path == f"{STAGING}/{REPAIR}":
                remove_tree(folder / item.path)
    return found


def _garbage(folder: Path) -> tuple[Garbage, ...]:
    staging, checkpoints = folder / STAGING, folder / CHECKPOINTS
    found = []
    for path in sorted(staging.iterdir()) if staging.is_dir() else []:
        lock = path.with_name(f"{path.name}.lock")
        if path.suffix == ".lock":
            is_abandoned = lock_holder(path) is None and not path.with_suffix("").exists()
        elif path.is_dir():
            is_abandoned = path.name == REPAIR or (lock.exists() and lock_holder(lock) is None)
        else:
            is_abandoned = True
        if is_abandoned:
            found.append(Garbage(f"{STAGING}/{path.name}", "abandoned by a build that ended", _size(path)))
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
