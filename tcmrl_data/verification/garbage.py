"""Removal of files that builds no longer need: abandoned staging and checkpoints of finished tasks."""

import re
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.build.work_files import check_work_files
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

CHECKPOINT = re.compile(r"task_([0-9]{5,10})")


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
    """Removes abandoned staging and checkpoints of tasks whose parts are all published.

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
    finished = _finished_tasks(folder)
    for path in sorted(checkpoints.iterdir()) if checkpoints.is_dir() else []:
        match = CHECKPOINT.fullmatch(path.name)
        if match and int(match[1]) in finished:
            found.append(Garbage(f"{CHECKPOINTS}/{path.name}", f"task {int(match[1])} is done", _size(path)))
    return tuple(found)


def _finished_tasks(folder: Path) -> set[int]:
    """Tasks with every part in the manifest; none where there is no manifest yet."""
    if not (folder / MANIFEST).exists():
        return set()
    manifest = read_manifest(folder)
    counts: dict[int, int] = {}
    for entry in manifest.parts:
        counts[entry.task] = counts.get(entry.task, 0) + 1
    return {task for task, count in counts.items() if count == len(manifest.steps)}


def _size(path: Path) -> int:
    files = [path, *path.rglob("*")] if path.is_dir() and not path.is_symlink() else [path]
    return sum(file.lstat().st_size for file in files if not file.is_dir())
