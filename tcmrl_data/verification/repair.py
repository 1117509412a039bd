"""Repair: parts that verification rejects are made again, checked by their ids, and put in their places."""

import contextlib
import stat
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from tcmrl_data.building.build import build_dataset
from tcmrl_data.building.work_files import BuildEvent, check_work_files
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Task, draw_tasks
from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    lock_file,
    make_folders,
    remove_abandoned,
    remove_tree,
    replace_file,
)
from tcmrl_data.foundation.errors import (
    BuildError,
    ManifestError,
    NondeterminismError,
    ReadOnlyError,
    SelectionError,
    StoreError,
)
from tcmrl_data.foundation.files import folder_problem, read_plain_file
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.parts.jobs import DeriveSpec, Job, derive_parts
from tcmrl_data.parts.making import Published, numbered, read_published
from tcmrl_data.parts.operation import can_be_made_again
from tcmrl_data.parts.own_operations import operation_of_run
from tcmrl_data.recipe.recipe import choose_tasks
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.manifest import (
    MANIFEST,
    MANIFEST_COPY,
    Manifest,
    Run,
    dataset_folder,
    read_manifest,
    restore_manifest,
    write_dataset,
)
from tcmrl_data.store.part import Platform, this_platform
from tcmrl_data.store.part_table import PARTS_TABLE, PartTable, parse_entries, parse_parts
from tcmrl_data.store.tables import (
    MAIN_RUN,
    TASKS,
    PartKey,
    key_of_file,
    parse_tasks,
    part_file,
    read_lines,
    read_sealed,
)
from tcmrl_data.verification.contents import recipe_environment
from tcmrl_data.verification.description import Finding, VerifyLevel, scan_dataset
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
        accepted: keys of the parts that were made again and came out with other ids.
    """

    dataset: Path
    repaired: tuple[PartKey, ...]
    tables: tuple[str, ...]
    left: tuple[Finding, ...]
    failed: tuple[str, ...]
    read_only: bool
    copied: tuple[PartKey, ...] = ()
    accepted: tuple[PartKey, ...] = ()
    root: str | None = None


def repair_dataset(
    path: str | Path,
    *,
    level: VerifyLevel = "digests",
    workers: int | None = None,
    copy: str | Path | None = None,
    accept: bool = False,
    progress: Callable[[BuildEvent], None] | None = None,
) -> RepairReport:
    """Makes the parts that verification rejects again, and only these, by their operations.

    Built parts are built with the manifest's recipes and seeds, others made from the parts that they name as
    their sources. New parts replace old ones only when all of their run are made and have the ids of the
    table; until then the dataset is not touched. Damaged tables are written again from the parts, if these
    have the manifest's root. Foreign files stay and are named.

    Args:
        level: level of the verification that selects the parts.
        copy: a dataset that holds some of the parts too; those are taken from it, if they have the digests
            of the table.
        accept: also make parts again whose platform is another one than this, and take them as they come out.
            The dataset then has another root, and the origin of its first run says which parts are new.

    Raises:
        ManifestError: the manifest and its copy are damaged. Delete both and the parts that `verify` names,
            then build with the options of the first build, which keeps the sound parts.
        BuildError: the tables are damaged and the parts do not have the manifest's root.
        LockedError: another process works on the dataset.
        ReadOnlyError: the folder cannot be written, and something is damaged.
        NondeterminismError: without `accept`, a part was made on another platform, so that nothing was begun,
            or came out with another id, so that nothing was replaced.
    """
    folder = dataset_folder(path)
    if not (folder / MANIFEST_COPY).exists():
        read_manifest(folder)
    check_work_files(folder, but=(TASKS, PARTS_TABLE))
    try:
        with lock_file(folder / LOCK, f"dataset {folder}"):
            return _Repair(folder, accept=accept, workers=workers, progress=progress).run(level, copy)
    except ReadOnlyError:
        findings = verify_dataset(folder, level=level).findings
        if any(not finding.foreign and not finding.note for finding in findings):
            raise
        return RepairReport(folder, (), (), findings, (), read_only=True, root=read_manifest(folder).root)


class _Repair:
    """One repair of a dataset; its lock is held."""

    def __init__(
        self,
        folder: Path,
        *,
        accept: bool,
        workers: int | None,
        progress: Callable[[BuildEvent], None] | None,
    ) -> None:
        self._folder, self._accept, self._workers, self._progress = folder, accept, workers, progress
        self._accepted: list[PartKey] = []

    def run(self, level: VerifyLevel, copy: str | Path | None) -> RepairReport:
        """Repairs tables, then parts; arguments and errors as of `repair_dataset`."""
        folder = self._folder
        remove_abandoned(folder)
        restored = (MANIFEST,) if restore_manifest(folder) else ()
        findings = find_problems(folder, level)
        damaged = sorted({finding.file for finding in findings if not finding.foreign} & {TASKS, PARTS_TABLE})
        if damaged:
            restore_tables(folder, read_manifest(folder))
            findings = find_problems(folder, level)
        keys = sorted({finding.key for finding in findings if finding.key is not None})
        copied = _copy_parts(self._dataset(), keys, copy) if copy is not None else []
        keys = [key for key in keys if key not in copied]
        failed = self._make_parts(keys) if keys else ()
        remove_tree(folder / STAGING / REPAIR)
        repaired = () if failed else tuple(key for key in keys if key not in self._accepted)
        return RepairReport(
            folder,
            repaired,
            (*restored, *damaged),
            find_problems(folder, level),
            failed,
            read_only=False,
            copied=tuple(copied),
            accepted=tuple(self._accepted),
            root=read_manifest(folder).root,
        )

    def _dataset(self) -> Dataset:
        return Dataset(self._folder, read_manifest(self._folder))

    def _make_parts(self, keys: Sequence[PartKey]) -> tuple[str, ...]:
        """Makes parts again and puts them in their places: built ones first, then what was made from them."""
        dataset = self._dataset()
        runs = {run.name: run for run in dataset.manifest.runs}
        for key in keys:
            problem = _lasting_damage(dataset, runs.get(key.run), key)
            if problem:
                return (f"{self._folder}: {problem}; take it from a copy of the dataset with --from COPY",)
        if not self._accept:
            _check_platforms(dataset, runs, keys)
        for run in sorted(runs.values(), key=lambda run: run.kind != "built"):
            chosen = [key for key in keys if key.run == run.name]
            if chosen:
                dataset, target = self._dataset(), self._folder / STAGING / REPAIR / run.name
                if run.kind == "built":
                    failed = _build_again(dataset, run, chosen, target, self._workers, self._progress)
                    made = {key: target / part_file(PartKey(key.task, key.step)) for key in chosen}
                else:
                    failed = _derive_again(dataset, run, chosen, target, self._workers)
                    made = {key: target / part_file(key) for key in chosen}
                if failed:
                    return failed
                self._put_in_place(dataset, made)
        return ()

    def _put_in_place(self, dataset: Dataset, made: Mapping[PartKey, Path]) -> None:
        """Replaces parts by new ones, if all have the ids of the table, or other ids are accepted."""
        folder = self._folder
        published = [read_published(file, key.run)[0] for key, file in made.items()]
        other = []
        for part in published:
            recorded = dataset.recorded_parts.entry(part.entry.key)
            assert recorded is not None
            if part.entry.id != recorded.id and not self._accept:
                raise NondeterminismError(
                    f"{folder}: the part of {part.entry.key} came out as {part.entry.id}, the table has "
                    f"{recorded.id}; repair on the platform that `tcmrl-data show` names, take the part from "
                    "a copy with --from COPY, or take the new one with --accept"
                )
            if part.entry.id != recorded.id:
                other.append(part.entry.key)
        for key, file in made.items():
            _put(folder, key, file.read_bytes())
        _record(dataset, published, accepted=other)
        self._accepted += other


def _lasting_damage(dataset: Dataset, run: Run | None, key: PartKey) -> str | None:
    """Why a part cannot be made again from what the dataset holds; None if it can."""
    if run is None:
        return f"the manifest has no run {key.run}, of which the part of {key} is"
    if not can_be_made_again(run):
        return f"the part of {key} was not built here, run {run.name} is {run.kind}"
    if run.kind != "built" and dataset.recorded_parts.entry(_source_of(run, key)) is None:
        return f"the part that the one of {key} was made from is not in this dataset"
    return None


def _source_of(run: Run, key: PartKey) -> PartKey:
    return PartKey(run.source_of(key.task), key.step, str((run.origin or {}).get("of", MAIN_RUN)))


def _check_platforms(dataset: Dataset, runs: Mapping[str, Run], keys: Sequence[PartKey]) -> None:
    here: dict[str, Platform] = {}
    simulating = {name for name in {key.run for key in keys} if operation_of_run(runs[name]).simulates}
    for key in keys:
        recipe, entry = runs[key.run].recipe, dataset.recorded_parts.entry(key)
        if key.run not in simulating or recipe is None or entry is None:
            continue
        if key.run not in here:
            here[key.run] = this_platform(recipe.make_environment(), recipe.behavior.source)
        differences = here[key.run].differences(dataset.manifest.platforms[entry.platform])
        if differences:
            raise NondeterminismError(
                f"{dataset.folder}: the part of {key} was made on another platform "
                f"({'; '.join(differences)[:200]}), where the same seeds give other episodes; repair there, "
                "take it from a copy of the dataset with --from COPY, or make it here with --accept, which "
                "gives the dataset another root"
            )


def _copy_parts(dataset: Dataset, keys: Sequence[PartKey], copy: str | Path) -> list[PartKey]:
    """Takes parts from another dataset that holds them with the digests of the table; returns their keys."""
    other = open_dataset(copy)
    places = {entry.sha256: entry.key for entry in other.recorded_parts.entries()}
    taken = []
    for key in keys:
        wanted = dataset.recorded_parts.entry(key)
        place = None if wanted is None else places.get(wanted.sha256)
        if place is not None:
            with contextlib.suppress(SelectionError, StoreError):  # damaged there too
                _put(dataset.folder, key, other.content(place))
                taken.append(key)
    return taken


def _put(folder: Path, key: PartKey, data: bytes) -> None:
    _clear(folder, part_file(key))
    replace_file(folder / part_file(key), data, staging=folder / STAGING)


def _record(dataset: Dataset, parts: Sequence[Published], *, accepted: Sequence[PartKey]) -> None:
    """Writes new lines for parts that have other bytes than before, as made on another platform."""
    manifest = dataset.manifest
    platforms = list(manifest.platforms)
    before = {entry.key: entry for entry in dataset.recorded_parts.entries()}
    now = {entry.key: entry for entry in numbered(parts, platforms)}
    if all(before[key] == entry for key, entry in now.items()):
        return
    table = PartTable.empty().with_entries(list((before | now).values()))
    if accepted:
        first, *others = manifest.runs
        replaced = [*(first.origin or {}).get("replaced", ()), *map(str, accepted)]
        origin = (first.origin or {}) | {"replaced": list(dict.fromkeys(replaced))}
        manifest = manifest.model_copy(
            update={"runs": (first.model_copy(update={"origin": origin}), *others)}
        )
    write_tables(dataset.folder, manifest, tasks=dataset.recorded_tasks, table=table, platforms=platforms)


def _clear(folder: Path, file: str) -> None:
    """Removes what is in the way of a part's file: a link, a folder, or something else; follows no link."""
    blocked = folder_problem(folder, file.rpartition("/")[0])
    old = folder / (blocked[0] if blocked else file)
    try:
        is_folder = stat.S_ISDIR(old.lstat().st_mode)
    except FileNotFoundError:
        return
    if is_folder:
        remove_tree(old)
    else:
        old.unlink()


def _build_again(
    dataset: Dataset,
    run: Run,
    keys: Sequence[PartKey],
    target: Path,
    workers: int | None,
    progress: Callable[[BuildEvent], None] | None,
) -> tuple[str, ...]:
    """Builds the tasks of damaged parts in a folder with their sound parts; their groups train along."""
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


def _derive_again(
    dataset: Dataset, run: Run, keys: Sequence[PartKey], target: Path, workers: int | None
) -> tuple[str, ...]:
    """Makes parts of a derived run from other parts; arguments and result as of `_build_again`."""
    assert run.recipe is not None
    operation = operation_of_run(run)
    jobs = tuple(Job(_source_of(run, key), key) for key in keys)
    source = next(found for found in dataset.manifest.runs if found.name == jobs[0].source.run)
    make_folders(target / STAGING)
    spec = DeriveSpec(
        dataset.folder.resolve(),
        target.resolve(),
        operation.name,
        operation.settings_of(run, source),
        run.recipe,
        run.seed,
        jobs,
    )
    try:
        derive_parts(spec, workers=workers)
    except (BuildError, StoreError) as error:
        return (str(error),)
    return ()


def restore_tables(folder: Path, manifest: Manifest) -> None:
    """Writes damaged tables again, from the parts and the recipe.

    Raises:
        BuildError: what was found does not have the manifest's root, or not its number of tasks; nothing was
            written.
    """
    platforms = list(manifest.platforms)
    try:
        table = parse_parts(read_sealed(folder / PARTS_TABLE, manifest.parts), folder / PARTS_TABLE)
    except ManifestError:
        table = _recover_parts(folder, manifest, platforms)
    try:
        tasks = parse_tasks(read_sealed(folder / TASKS, manifest.tasks), folder / TASKS)
    except ManifestError:
        tasks = _draw_again(table, manifest)
    if len(tasks) != manifest.tasks.lines or table.without_tasks(manifest.dropped).root != manifest.root:
        raise BuildError(
            f"{folder}: its tables are damaged, and what its parts tell does not have the manifest's root; "
            f"delete {MANIFEST} and {MANIFEST_COPY} and run the first `tcmrl-data build` again, which keeps "
            "the sound parts"
        )
    write_tables(folder, manifest, tasks=tasks, table=table, platforms=platforms)


def write_tables(
    folder: Path,
    manifest: Manifest,
    *,
    tasks: Sequence[Task],
    table: PartTable,
    platforms: Sequence[Platform],
) -> None:
    """Replaces the tables and then the manifest that seals them.

    If this is interrupted the tables are not those of the manifest, and `restore_tables` finds them again.
    """
    write_dataset(
        folder,
        label=manifest.label,
        data_version=manifest.data_version,
        runs=manifest.runs,
        derivation=manifest.derivation,
        platforms=platforms,
        tasks=tasks,
        dropped=manifest.dropped,
        table=table,
    )


def _recover_parts(folder: Path, manifest: Manifest, platforms: list[Platform]) -> PartTable:
    """The table that has the manifest's root, of sound parts and of sound lines; the last if none has it.

    A damaged part stands in its line alone. A sound part without a line may not be recorded yet.
    """
    sound = {entry.key: entry for entry in numbered(_read_parts(folder), platforms)}
    lines = b""
    with contextlib.suppress(ManifestError):  # no plain file at all
        lines = read_lines(folder / PARTS_TABLE, manifest.parts.bytes)
    recorded = {
        entry.key: entry
        for line in lines.splitlines(keepends=True)
        for entry in parse_entries(line)
        if entry.platform < len(manifest.platforms)
    }
    in_lines = {key: sound.get(key, entry) for key, entry in recorded.items()}
    choices = (recorded | sound, in_lines, sound)
    for entries in choices:
        table = PartTable.empty().with_entries(list(entries.values()))
        if table.without_tasks(manifest.dropped).root == manifest.root:
            break
    return table


def _read_parts(folder: Path) -> list[Published]:
    keys = sorted(key for key in map(key_of_file, scan_dataset(folder).files) if key is not None)

    def read(key: PartKey) -> Published | None:
        try:
            published = read_published(folder / part_file(key), key.run)[0]
        except (StoreError, ManifestError):
            return None
        return published if published.entry.key == key else None

    with ThreadPoolExecutor(available_cores()) as pool:
        return [part for part in pool.map(read, keys) if part is not None]


def _draw_again(table: PartTable, manifest: Manifest) -> tuple[Task, ...]:
    """The tasks of the parts and of the recipe's choice, as the recipe draws them.

    Their splits are those of the derivation, if it has changed any.
    """
    if not manifest.is_drawn:
        raise BuildError(
            f"{TASKS} is damaged, and nobody can draw the tasks of foreign data; import or record them again"
        )
    recipe = manifest.recipe
    environment = recipe_environment(recipe)
    if isinstance(environment, str):
        raise ManifestError(f"{MANIFEST}: {environment}")
    present = set(table.columns["task"].tolist())
    if len(present) < manifest.tasks.lines:
        present |= {task.index for task in choose_tasks(recipe)}
    splits = manifest.derivation.split_of_tasks() if manifest.derivation else {}
    return tuple(
        replace(task, split=splits.get(task.index, task.split))
        for task in draw_tasks(environment)
        if task.index in present
    )
