"""Applying an operation to parts of a dataset: in which runs the new parts lie, and how they are made."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.building.work_files import check_work_files
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.disk import LOCK, lock_file, remove_abandoned
from tcmrl_data.foundation.errors import BuildError, NondeterminismError, SelectionError, StoreError
from tcmrl_data.foundation.records import validate_table
from tcmrl_data.operations.assembly import PlannedPart, append_parts, derivation_of, open_assembly
from tcmrl_data.parts.jobs import DeriveSpec, Job, derive_parts
from tcmrl_data.parts.operation import OPERATIONS
from tcmrl_data.parts.own_operations import OWN_OPERATIONS, operation_of_run
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.manifest import FOREIGN_KINDS, Derivation, Manifest, Run, read_manifest
from tcmrl_data.store.part import this_platform
from tcmrl_data.store.tables import MAIN_RUN, PartKey


def apply_operation(
    path: str | Path | Dataset,
    out: str | Path,
    operation: str,
    settings: Mapping[str, Any] | None = None,
    *,
    tasks: Sequence[int] | None = None,
    snapshots: str = "all",
    workers: int | None = None,
) -> Dataset:
    """Makes a dataset whose parts an operation makes of those of another's run `main`, each in its own task.

    The same call goes on after a stop. `verify_dataset` and `repair_dataset` make the parts again by the same
    operation, if they have the parts that these were made from: merge the two datasets for it.

    Args:
        out: folder of the new dataset, which holds the new parts alone, in a run with the operation's name.
        operation: name of a plug-in of `tcmrl.operations`.
        tasks: indices of the tasks whose parts are taken; all where None.
        workers: processes at the same time; one per core where None.

    Raises:
        UnknownNameError: no installed package has the operation.
        SelectionError: settings that the operation does not take, or nothing selected.
        BuildError: an operation that simulates, and parts whose seeds are not known, or a failed worker.
        NondeterminismError: an operation that simulates, and parts of another platform.
        StoreError: `out` holds something else, or a part is damaged.

    Example:
        >>> import tcmrl_data
        >>> tcmrl_data.apply_operation("data/pendulum", "data/half", "every-nth", {"n": 2})  # doctest: +SKIP
    """
    dataset = path if isinstance(path, Dataset) else open_dataset(path)
    if operation in OWN_OPERATIONS:
        raise SelectionError(f"operation {operation} has a function of its own: derive, extend or relabel")
    kind = OPERATIONS.get(operation)
    keys = keys_of_run(dataset, MAIN_RUN, tasks, snapshots)
    common = dict(settings or {})
    example = kind.settings_for(common, dataset.task(keys[0].task))
    validate_table(kind.Settings, example, place=f"operation {operation}", error=SelectionError)
    source = next(found for found in dataset.manifest.runs if found.name == MAIN_RUN)
    recipe = source.recipe or dataset.manifest.recipe
    if kind.simulates:
        source, recipe, _ = simulated_run(dataset, MAIN_RUN)
        check_parts(dataset, source, keys, policy=False)
    foreign = source.kind in FOREIGN_KINDS
    template = Run(
        name=operation,
        kind=source.kind if foreign else "derived",
        seed=source.seed,
        recipe=recipe,
        origin=source.origin if foreign else {"operation": operation, "of": MAIN_RUN, "settings": common},
        steps=None,
    )
    tasks_of = sorted({key.task for key in keys})
    names = {(task, task): operation for task in tasks_of}
    recorded = {
        "operation": operation,
        "settings": common,
        "tasks": tasks_of,
        "snapshots": snapshots,
        "of": MAIN_RUN,
        "run": operation,
    }
    jobs = tuple(jobs_of_pairs(names, keys))
    spec = DeriveSpec(dataset.path_on_disk, Path(out), operation, common, recipe, source.seed, jobs)
    derivation = derivation_of("apply", recorded, [dataset])
    runs = runs_like(template, names)
    make_of_parts(dataset, Path(out), spec, derivation=derivation, runs=runs, workers=workers)
    return open_dataset(out)


def make_of_parts(
    dataset: Dataset,
    out: Path,
    spec: DeriveSpec,
    *,
    derivation: Derivation,
    runs: Sequence[Run],
    with_old: bool = False,
    label: str | None = None,
    workers: int | None,
    progress: Callable[[int, int], None] | None = None,
) -> Manifest:
    """Makes a dataset of the parts that an operation makes of another's.

    Args:
        derivation: what is made; the same one goes on after a stop.
        with_old: the new dataset has all parts of the other, too.
    """
    kept = {job.key.task for job in spec.jobs}
    with open_assembly(out, derivation, [dataset]) as assembly:
        if with_old:
            assembly.copy([PlannedPart(key, dataset, key) for key in dataset.parts])
        for published in derive_parts(spec, workers=workers, progress=progress):
            assembly.take(published)
        return assembly.finish(
            name=dataset.name,
            data_version=dataset.manifest.data_version,
            runs=runs,
            tasks=[task for task in dataset.tasks if with_old or task.index in kept],
            label=label,
        )


def add_parts(
    dataset: Dataset,
    spec: DeriveSpec,
    *,
    runs: Sequence[Run],
    workers: int | None,
    progress: Callable[[int, int], None] | None,
) -> Manifest:
    """Adds the parts that an operation makes of a dataset's to the dataset itself; arguments as above."""
    folder = dataset.folder
    if dataset.path != folder:
        raise StoreError(
            f"{dataset.path} is a view, to which no parts can be added; name a new dataset by --out"
        )
    check_work_files(folder)
    with lock_file(folder / LOCK, f"dataset {folder}"):
        remove_abandoned(folder)
        if read_manifest(folder).digest != dataset.manifest.digest:
            raise StoreError(f"{folder} has changed meanwhile; run the same command again")
        made = derive_parts(spec, workers=workers, progress=progress)
        return append_parts(dataset, runs=runs, parts=made)


def simulated_run(dataset: Dataset, name: str) -> tuple[Run, Recipe, int]:
    """A run whose parts have keyed seeds, its recipe and its root seed."""
    known = {run.name: run for run in dataset.manifest.runs}
    if name not in known:
        raise SelectionError(f"{dataset.path} has no run {name!r}; it has {', '.join(sorted(known))}")
    run = known[name]
    if run.recipe is None or run.seed is None or not operation_of_run(run).own_seeds:
        raise BuildError(
            f"{dataset.path}: run {name} is {run.kind}, so the seeds of its episodes are not known; "
            "name one that was built"
        )
    if run.sources:
        raise BuildError(
            f"{dataset.path}: the policies of run {name} are from other tasks; name the run of their own"
        )
    return run, run.recipe, run.seed


def check_parts(
    dataset: Dataset, run: Run, keys: Iterable[PartKey], *, policy: bool, allow_drift: bool = False
) -> None:
    """Refuses parts that cannot be simulated here as they were.

    Raises:
        BuildError: a part without policy, or with another seed than its run.
    """
    here = this_platform(dataset.environment, dataset.manifest.recipe.behavior.source)
    differences = [here.differences(platform) for platform in dataset.manifest.platforms]
    for key in keys:
        identity = dataset.part(*key).identity
        file = dataset.file_of(key)
        if identity.seed != run.seed or (policy and identity.policy is None):
            raise BuildError(f"{file}: has no policy with the seed of run {key.run}; select other parts")
        found = differences[dataset.entry(key).platform]
        if found and not allow_drift:
            raise NondeterminismError(
                f"{file}: was made on another platform ({'; '.join(found)[:200]}), where the same seeds "
                f"give other episodes; use that platform{', or say --allow-drift' if policy else ''}"
            )


def keys_of_run(dataset: Dataset, run: str, tasks: Sequence[int] | None, snapshots: str) -> list[PartKey]:
    """The parts of a run that a selection leaves, sorted."""
    chosen = dataset.select(tasks=tasks, snapshots=snapshots)
    keys = sorted(key for keys in chosen.parts.values() for key in keys if key.run == run)
    if not keys:
        raise SelectionError(f"{dataset.path}: the selection holds no part of run {run}; choose others")
    return keys


Pair = tuple[int, int]
"""Index of the task that something comes from, and of the task that it goes to."""


def nearest_pairs(tasks: Sequence[Task], chosen: Sequence[Task], number: int) -> list[Pair]:
    """From every chosen task to the nearest other tasks of its split, all nearest ones first.

    Tasks are compared by the Euclidean distance of their parameters, each in units of its standard deviation
    over all tasks; of tasks at equal distances the one with the smaller index is nearer.

    Raises:
        SelectionError: parameters that are not numbers or not equally many, or too few tasks in a split.
    """
    scaled = _scaled(tasks)
    rows = {task.index: row for row, task in enumerate(tasks)}
    is_test = np.array([task.split == "test" for task in tasks])
    found: list[list[int]] = []
    for task in chosen:
        distances = np.linalg.norm(scaled - scaled[rows[task.index]], axis=1)
        others = np.flatnonzero(is_test == (task.split == "test"))
        others = others[others != rows[task.index]]
        if len(others) < number:
            raise SelectionError(
                f"task {task.index} has {len(others)} other {task.split} tasks, not {number}; "
                "choose fewer neighbours"
            )
        order = others[np.argsort(distances[others], kind="stable")[:number]]
        found.append([tasks[row].index for row in order])
    return [
        (task.index, near[rank]) for rank in range(number) for task, near in zip(chosen, found, strict=True)
    ]


def runs_of_pairs(pairs: Iterable[Pair], run: str) -> dict[Pair, str]:
    """The runs in which the parts of pairs lie, so that no two of a task have the same key.

    The first pair that goes to a task is in `run`, the second one in `run-2`, and so on.
    """
    counts: dict[int, int] = {}
    runs = {}
    for source, target in pairs:
        counts[target] = counts.get(target, 0) + 1
        runs[source, target] = run if counts[target] == 1 else f"{run}-{counts[target]}"
    return runs


def runs_like(template: Run, names: Mapping[Pair, str]) -> list[Run]:
    """The runs of pairs: each as the template, with its own name and the tasks that its parts are from."""
    return [
        template.model_copy(
            update={
                "name": name,
                "sources": tuple(
                    sorted(
                        (target, source)
                        for (source, target), found in names.items()
                        if found == name and source != target
                    )
                ),
            }
        )
        for name in dict.fromkeys(names.values())
    ]


def jobs_of_pairs(runs: Mapping[Pair, str], keys: Sequence[PartKey]) -> list[Job]:
    """The parts that are made of the keys of the pairs' first tasks, in the runs of the pairs."""
    return [
        Job(key, PartKey(target, key.step, run))
        for (source, target), run in runs.items()
        for key in keys
        if key.task == source
    ]


def _scaled(tasks: Sequence[Task]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Parameters of the tasks in units of their standard deviations, (tasks, parameters)."""
    rows = [list(_numbers(task.parameters, task)) for task in tasks]
    if len({len(row) for row in rows}) != 1 or not rows[0]:
        raise SelectionError("the tasks do not have equally many parameters, so none is near another")
    values = np.array(rows, dtype=np.float64)
    spread = values.std(axis=0)
    return values / np.where(spread > 0, spread, 1.0)


def _numbers(value: Any, task: Task) -> Iterable[float]:
    if isinstance(value, Mapping):
        for key in sorted(value):
            yield from _numbers(value[key], task)
    elif isinstance(value, list | tuple):
        for member in value:
            yield from _numbers(member, task)
    elif isinstance(value, int | float):
        yield float(value)
    else:
        raise SelectionError(f"task {task.index} has a parameter that is no number, so none is near it")
