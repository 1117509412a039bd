"""Repair: rebuilds rejected parts in the staging folder, checks their ids, and replaces the old ones."""

import shutil
import stat
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.build.build import BuildReport, build_dataset
from tcmrl_data.build.events import BuildEvent
from tcmrl_data.build.work_files import check_work_files
from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    lock_file,
    make_folders,
    move_into_place,
    remove_abandoned,
    remove_tree,
    replace_file,
)
from tcmrl_data.foundation.errors import NondeterminismError, ReadOnlyError
from tcmrl_data.foundation.plain_files import folder_problem
from tcmrl_data.store.layout import GROUP
from tcmrl_data.store.manifest import (
    MANIFEST,
    Manifest,
    dataset_folder,
    part_folder,
    read_manifest,
    read_sealed_part,
    seal,
)
from tcmrl_data.verification.verify import Finding, Key, VerifyLevel, verify_dataset

REPAIR = "repair"
"""Folder in `.staging` for rebuilt parts."""


@dataclass(frozen=True)
class RepairReport:
    """What a repair did.

    Attributes:
        repaired: (task, step) of the parts that were made again, with the ids that they had.
        groups: group records above the parts that were written again.
        left: findings that a repair leaves to people: foreign files, and values of the manifest.
        failed: one line per task that could not be made again; the dataset is then as it was.
        read_only: the folder cannot be written, and nothing had to be.
    """

    dataset: Path
    repaired: tuple[Key, ...]
    groups: tuple[str, ...]
    left: tuple[Finding, ...]
    failed: tuple[str, ...]
    read_only: bool


def repair_dataset(
    path: str | Path,
    *,
    level: VerifyLevel = "digests",
    workers: int | None = None,
    progress: Callable[[BuildEvent], None] = lambda event: None,
) -> RepairReport:
    """Rebuilds the parts that verification rejects, and only these, with the manifest's recipe and seed.

    New parts replace old ones only when all are made and have the ids of the manifest; until then the
    dataset is not touched. What lies in the folder of a replaced part goes with it; every other foreign
    file stays and is named.

    Args:
        path: the dataset's folder or its `manifest.json`.
        level: level of the verification that selects the parts.
        workers: units run at the same time.
        progress: called with the events of the build.

    Raises:
        ManifestError: the manifest itself is damaged. Delete the part folders that `verify` names and
            the manifest, then build with the options of the first build, which keeps the sound parts.
        LockedError: another process works on the dataset.
        ReadOnlyError: the folder cannot be written, and something is damaged.
        NondeterminismError: a part came out with another id; nothing was replaced.
    """
    folder = dataset_folder(path)
    manifest = read_manifest(folder)
    check_work_files(folder)
    try:
        return _repair(folder, manifest, level=level, workers=workers, progress=progress)
    except ReadOnlyError:
        findings = verify_dataset(folder, level=level).findings
        if any(not finding.foreign for finding in findings):
            raise
        return RepairReport(folder, (), (), findings, (), read_only=True)


def _repair(
    folder: Path,
    manifest: Manifest,
    *,
    level: VerifyLevel,
    workers: int | None,
    progress: Callable[[BuildEvent], None],
) -> RepairReport:
    with lock_file(folder / LOCK, f"dataset {folder}"):
        remove_abandoned(folder)
        findings = verify_dataset(folder, level=level).findings
        rejected = {
            (finding.task, finding.step): finding
            for finding in findings
            if finding.task is not None and finding.step is not None and not finding.foreign
        }
        keys = tuple(sorted((task, step) for task, step in rejected if task is not None and step is not None))
        failed: tuple[str, ...] = ()
        if keys:
            failed = _make_again(folder, manifest, keys, workers, progress).failed
        if failed:
            return RepairReport(folder, (), (), findings, failed, read_only=False)
        groups = _restore(folder, manifest, keys, findings)
        remove_tree(folder / STAGING / REPAIR)
    left = verify_dataset(folder, level=level).findings
    return RepairReport(folder, keys, groups, left, (), read_only=False)


def _make_again(
    folder: Path,
    manifest: Manifest,
    keys: tuple[Key, ...],
    workers: int | None,
    progress: Callable[[BuildEvent], None],
) -> BuildReport:
    """Builds the affected tasks in `.staging/repair`, sound parts copied there, and compares ids."""
    target = folder / STAGING / REPAIR
    make_folders(target)
    tasks = sorted({task for task, _ in keys})
    for entry in manifest.parts:
        place = part_folder(entry.task, entry.step)
        if entry.task in tasks and (entry.task, entry.step) not in keys:
            make_folders((target / place).parent)
            shutil.copytree(folder / place, target / place)
    report = build_dataset(
        manifest.recipe, target, seed=manifest.seed, tasks=tasks, workers=workers, progress=progress
    )
    if report.failed:
        return report
    ids = {(entry.task, entry.step): entry.id for entry in manifest.parts}
    for task, step in keys:
        found = read_sealed_part(target / part_folder(task, step) / "part.json")[0].id
        if found != ids[task, step]:
            remove_tree(target)
            raise NondeterminismError(
                f"{folder}: task {task} at step {step} came out as {found}, the manifest has "
                f"{ids[task, step]}; repair on the CPU model and package versions that its part.json names"
            )
    return report


def _restore(
    folder: Path, manifest: Manifest, keys: tuple[Key, ...], findings: tuple[Finding, ...]
) -> tuple[str, ...]:
    """Puts the new parts and the group records in place, and their new digests into the manifest."""
    sealed: dict[Key, str] = {}
    for key in keys:
        place = part_folder(*key)
        new = folder / STAGING / REPAIR / place
        sealed[key] = read_sealed_part(new / "part.json")[1]
        _clear(folder, place)
        make_folders((folder / place).parent)
        move_into_place(new, folder / place)
    groups = _group_files(keys) | {
        finding.file
        for finding in findings
        if not finding.foreign and finding.task is None and finding.file != MANIFEST
    }
    restored = []
    for file in sorted(groups):
        target = folder / file
        if target.name == "zarr.json" and not target.is_dir() and not _holds(target):
            replace_file(target, GROUP, staging=folder / STAGING)
            restored.append(file)
    if sealed:
        fields = manifest.model_dump(mode="json", exclude={"digest"})
        for entry in fields["parts"]:
            entry["sha256"] = sealed.get((entry["task"], entry["step"]), entry["sha256"])
        replace_file(folder / MANIFEST, seal(fields), staging=folder / STAGING)
    return tuple(restored)


def _group_files(keys: tuple[Key, ...]) -> set[str]:
    """Group records above parts."""
    parents = {parent for key in keys for parent in Path(part_folder(*key)).parents}
    return {str(parent / "zarr.json") for parent in parents}


def _holds(file: Path) -> bool:
    return not file.is_symlink() and file.is_file() and file.read_bytes() == GROUP


def _clear(folder: Path, place: str) -> None:
    """Removes what is at a part's path, or a link or file on the way to it; never follows a link."""
    blocked = folder_problem(folder, place)
    old = folder / (blocked[0] if blocked else place)
    try:
        is_folder = stat.S_ISDIR(old.lstat().st_mode)
    except FileNotFoundError:
        return
    if not is_folder:
        old.unlink()
        return
    staged = folder / STAGING / f"replaced.{uuid.uuid4().hex}"
    with lock_file(staged.with_name(f"{staged.name}.lock"), "this removal") as lock:
        move_into_place(old, staged)
        remove_tree(staged)
        lock.unlink()
