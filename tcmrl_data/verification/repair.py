"""Repair: parts that verification rejects are made again, checked by their ids, and put in their places."""

import stat
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.build import build_dataset
from tcmrl_data.building.events import BuildEvent
from tcmrl_data.building.work_files import check_work_files
from tcmrl_data.dataset.dataset import Dataset
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
from tcmrl_data.foundation.errors import BuildError, NondeterminismError, ReadOnlyError, StoreError
from tcmrl_data.foundation.plain_files import folder_problem, read_plain_file
from tcmrl_data.parts.making import Published, numbered, read_published
from tcmrl_data.parts.rollouts import EXTEND
from tcmrl_data.parts.worker import DeriveSpec, Job, derive_parts
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.keys import MAIN_RUN, PartKey, part_file
from tcmrl_data.store.manifest import (
    MANIFEST,
    MANIFEST_COPY,
    Run,
    dataset_folder,
    read_manifest,
    restore_manifest,
)
from tcmrl_data.store.part_table import PARTS_TABLE, PartTable
from tcmrl_data.store.task_table import TASKS
from tcmrl_data.verification.description import Finding, VerifyLevel
from tcmrl_data.verification.tables import restore_tables, write_tables
from tcmrl_data.verification.verify import find_problems, verify_dataset

REPAIR = "repair"
"""Folder in `.staging` for rebuilt parts."""


@dataclass(frozen=True)
class RepairReport:
    """What a repair did.

    Attributes:
        repaired: keys of the parts that were made again, with the ids that they had.
        tables: tables that were written again from the parts, and the manifest if it was, from its copy.
        left: findings that a repair leaves to people: foreign files, and values of the manifest.
        failed: one line per task that could not be made again; the dataset is then as it was.
        read_only: the folder cannot be written, and nothing had to be.
    """

    dataset: Path
    repaired: tuple[PartKey, ...]
    tables: tuple[str, ...]
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
    """Makes the parts that verification rejects again, and only these, with the manifest's recipes and seeds.

    Built parts are built, extended ones made from the policies of other parts. New parts replace old ones
    only when all of their kind are made and have the ids of the table; until then the dataset is not touched.
    Damaged tables are written again from the parts, if these have the manifest's root. Foreign files stay
    and are named.

    Args:
        path: the dataset's folder or its `manifest.json`.
        level: level of the verification that selects the parts.
        workers: units run at the same time.
        progress: called with the events of the build.

    Raises:
        ManifestError: the manifest and its copy are damaged. Delete both and the parts that `verify` names,
            then build with the options of the first build, which keeps the sound parts.
        BuildError: the tables are damaged and the parts do not have the manifest's root.
        LockedError: another process works on the dataset.
        ReadOnlyError: the folder cannot be written, and something is damaged.
        NondeterminismError: a part came out with another id; nothing was replaced.
    """
    folder = dataset_folder(path)
    if not (folder / MANIFEST_COPY).exists():
        read_manifest(folder)
    check_work_files(folder, but=(TASKS, PARTS_TABLE))
    try:
        return _repair(folder, level=level, workers=workers, progress=progress)
    except ReadOnlyError:
        findings = verify_dataset(folder, level=level).findings
        if any(not finding.foreign for finding in findings):
            raise
        return RepairReport(folder, (), (), findings, (), read_only=True)


def _repair(
    folder: Path,
    *,
    level: VerifyLevel,
    workers: int | None,
    progress: Callable[[BuildEvent], None],
) -> RepairReport:
    with lock_file(folder / LOCK, f"dataset {folder}"):
        remove_abandoned(folder)
        restored = (MANIFEST,) if restore_manifest(folder) else ()
        findings = find_problems(folder, level)
        damaged = sorted({finding.file for finding in findings if not finding.foreign} & {TASKS, PARTS_TABLE})
        if damaged:
            restore_tables(folder, read_manifest(folder))
            findings = find_problems(folder, level)
        keys = tuple(sorted({finding.key for finding in findings if finding.key is not None}))
        failed: tuple[str, ...] = ()
        if keys:
            failed = _replace_parts(folder, keys, workers, progress)
        remove_tree(folder / STAGING / REPAIR)
        left = find_problems(folder, level)
    tables = (*restored, *damaged)
    return RepairReport(folder, () if failed else keys, tables, left, failed, read_only=False)


def _replace_parts(
    folder: Path, keys: Sequence[PartKey], workers: int | None, progress: Callable[[BuildEvent], None]
) -> tuple[str, ...]:
    """Makes parts again and puts them in their places: built ones first, then what was made from them.

    Returns:
        One line per failure; the parts of that kind of run, and of later kinds, are then as they were.

    Raises:
        NondeterminismError: a part came out with another id; no part of that kind of run was replaced.
    """
    runs = {run.name: run for run in read_manifest(folder).runs}
    for key in keys:
        problem = lasting_damage(runs.get(key.run), key)
        if problem:
            return (f"{folder}: {problem}; restore it from a copy",)
    for kind in ("built", "extended"):
        dataset = Dataset(folder, read_manifest(folder))
        made: dict[PartKey, Path] = {}
        for run in runs.values():
            chosen = [key for key in keys if key.run == run.name and run.kind == kind]
            if not chosen:
                continue
            target = folder / STAGING / REPAIR / run.name
            if kind == "built":
                failed = build_again(dataset, run, chosen, target, workers, progress)
            else:
                failed = extend_again(dataset, run, chosen, target, workers)
            if failed:
                return failed
            made |= {key: made_file(target, run, key) for key in chosen}
        _put_in_place(dataset, made)
    return ()


def _put_in_place(dataset: Dataset, made: dict[PartKey, Path]) -> None:
    """Replaces parts by new ones, if all have the ids of the table."""
    folder = dataset.folder
    published = [read_published(file, key.run)[0] for key, file in made.items()]
    for part in published:
        recorded = dataset.recorded_parts.entry(part.entry.key)
        assert recorded is not None
        if part.entry.id != recorded.id:
            raise NondeterminismError(
                f"{folder}: the part of {part.entry.key} came out as {part.entry.id}, the table has "
                f"{recorded.id}; repair on the platform that `tcmrl-data show` names"
            )
    for key, file in made.items():
        _clear(folder, part_file(key))
        replace_file(folder / part_file(key), file.read_bytes(), staging=folder / STAGING)
    _record(dataset, published)


def _record(dataset: Dataset, parts: Sequence[Published]) -> None:
    """Writes new lines for parts that have other bytes than before, as made on another platform."""
    platforms = list(dataset.manifest.platforms)
    before = {entry.key: entry for entry in dataset.recorded_parts.entries()}
    now = {entry.key: entry for entry in numbered(parts, platforms)}
    if all(before[key] == entry for key, entry in now.items()):
        return
    lines = before | now
    table = PartTable.empty().with_entries(list(lines.values()))
    write_tables(
        dataset.folder, dataset.manifest, tasks=dataset.recorded_tasks, table=table, platforms=platforms
    )


def _clear(folder: Path, file: str) -> None:
    """Removes what is in the way of a part's file: a link, a folder, or something else; follows no link."""
    blocked = folder_problem(folder, file.rpartition("/")[0])
    old = folder / (blocked[0] if blocked else file)
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


def lasting_damage(run: Run | None, key: PartKey) -> str | None:
    """Why a part cannot be made again from what the dataset holds; None if it can.

    Args:
        run: its run, None if the manifest has no such run.
        key: of the part.
    """
    if run is None:
        return f"the manifest has no run {key.run}, of which the part of {key} is"
    if run.kind not in ("built", "extended") or run.recipe is None or run.seed is None:
        return f"the part of {key} was not built here, run {run.name} is {run.kind}"
    return None


def made_file(target: Path, run: Run, key: PartKey) -> Path:
    """The file of a part that was made again in the folder `target`."""
    return target / part_file(PartKey(key.task, key.step) if run.kind == "built" else key)


def build_again(
    dataset: Dataset,
    run: Run,
    keys: Sequence[PartKey],
    target: Path,
    workers: int | None,
    progress: Callable[[BuildEvent], None],
) -> tuple[str, ...]:
    """Builds the affected tasks of a run in a folder, where their sound parts lie; their groups train along.

    Args:
        dataset: that holds the damaged parts.
        run: a built run.
        keys: of the run's damaged parts.
        target: folder for the new parts; `made_file` says where.
        workers: units run at the same time.
        progress: called with the events of the build.

    Returns:
        One line per failure.
    """
    assert run.recipe is not None
    assert run.seed is not None
    tasks = {key.task for key in keys}
    group_size = run.recipe.make_source().group_size
    groups = {task // group_size for task in tasks}
    recorded = dataset.recorded_tasks
    others = [
        task.index for task in recorded if task.index // group_size in groups and task.index not in tasks
    ]
    make_folders(target)
    for task in sorted(tasks):
        for key in dataset.recorded_parts.keys_of(task):
            if key.run == run.name and key not in keys:
                copy = target / part_file(PartKey(key.task, key.step))
                data = read_plain_file(dataset.file_of(key), limit=LARGEST_ARCHIVE)
                replace_file(copy, data, staging=target / STAGING)
    report = build_dataset(
        run.recipe,
        target,
        seed=run.seed,
        tasks=sorted(tasks),
        dropped=others,
        workers=workers,
        progress=progress,
    )
    return report.failed


def extend_again(
    dataset: Dataset, run: Run, keys: Sequence[PartKey], target: Path, workers: int | None
) -> tuple[str, ...]:
    """Makes parts of an extended run from the stored policies; arguments and result as of `build_again`."""
    assert run.recipe is not None
    assert run.seed is not None
    origin = run.origin or {}
    settings = {name: origin.get(name) for name in ("first_episode", "noise")}
    of = origin.get("of", MAIN_RUN)
    jobs = tuple(Job(PartKey(run.source_of(key.task), key.step, of), key) for key in keys)
    make_folders(target / STAGING)
    spec = DeriveSpec(
        dataset.folder.resolve(), target.resolve(), EXTEND, settings, run.recipe, run.seed, jobs
    )
    try:
        derive_parts(spec, workers=workers)
    except (BuildError, StoreError) as error:
        return (str(error),)
    return ()
