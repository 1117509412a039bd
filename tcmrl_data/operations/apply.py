"""Applying an operation to parts of a dataset: what it may read, and in which runs the new parts lie."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import BuildError, NondeterminismError, SelectionError
from tcmrl_data.foundation.records import validate_table
from tcmrl_data.operations.assembly import Plan, carry_out, derivation_of
from tcmrl_data.parts.jobs import DeriveSpec, Job
from tcmrl_data.parts.operation import OPERATIONS
from tcmrl_data.parts.own_operations import OWN_OPERATIONS, operation_of_run
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.manifest import FOREIGN_KINDS, Run
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
    indices = sorted({key.task for key in keys})
    recorded = {
        "operation": operation,
        "settings": common,
        "tasks": indices,
        "snapshots": snapshots,
        "of": MAIN_RUN,
        "run": operation,
    }
    runs, jobs = runs_of_pairs([(index, index) for index in indices], keys, template)
    spec = DeriveSpec(dataset.path_on_disk, Path(out), operation, common, recipe, source.seed, jobs)
    derivation = derivation_of("apply", recorded, [dataset])
    tasks_of = [dataset.task(index) for index in indices]
    carry_out(Plan(runs, tasks_of, (), derivation, [dataset], spec=spec), Path(out), workers=workers)
    return open_dataset(out)


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


def runs_of_pairs(
    pairs: Iterable[Pair], keys: Sequence[PartKey], template: Run
) -> tuple[list[Run], tuple[Job, ...]]:
    """The runs, and the parts in them, that are made of the keys of the pairs' first tasks.

    Of the pairs that go to a task, the parts of the first one are in the template's run, those of the second
    one in `<run>-2` and so on, so that no two parts have the same key.
    """
    counts: Counter[int] = Counter()
    sources: dict[str, list[Pair]] = {}
    jobs: list[Job] = []
    for source, target in pairs:
        counts[target] += 1
        name = template.name if counts[target] == 1 else f"{template.name}-{counts[target]}"
        sources.setdefault(name, []).append((target, source))
        jobs += [Job(key, PartKey(target, key.step, name)) for key in keys if key.task == source]
    runs = []
    for name, found in sources.items():
        others = tuple(sorted((target, source) for target, source in found if target != source))
        runs.append(template.model_copy(update={"name": name, "sources": others}))
    return runs, tuple(jobs)


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
