"""What a new dataset is to consist of: whole parts of others, parts made of them, and whose go where."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import BuildError, NondeterminismError, SelectionError
from tcmrl_data.operations.assembly import Copied, open_assembly
from tcmrl_data.parts.jobs import Job
from tcmrl_data.parts.making import make_from
from tcmrl_data.parts.operation import Operation, StoredPart, can_be_made_again
from tcmrl_data.parts.own_operations import operation_of_run
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.manifest import Derivation, Manifest, Run
from tcmrl_data.store.part import PartRecord, this_platform
from tcmrl_data.store.tables import PartKey

Progress = Callable[[int, int], None]
"""Called with parts done and parts in all."""


@dataclass(frozen=True)
class PlannedPart:
    """A part of the new dataset.

    Attributes:
        key: in the new dataset.
        source: where it comes from.
        source_key: in the source.
        operation: makes the part of the other, without a simulator; None takes the part over as it is.
    """

    key: PartKey
    source: Dataset
    source_key: PartKey
    operation: Operation[Any] | None = None

    def make(self) -> tuple[PartRecord, bytes]:
        """The record and the archive of a part that is made anew.

        Raises:
            StoreError: the part of the source is damaged.
            SelectionError: it has no such array, or no such episode.
        """
        assert self.operation is not None
        source = StoredPart.of(self.source, self.source_key)
        return make_from(self.operation, source, task=self.source.task(self.source_key.task))


@dataclass(frozen=True)
class Plan:
    """A new dataset before it is made.

    Attributes:
        name: the environment's name.
        data_version: of the parts.
        runs: how the parts were made, the first with a recipe.
        tasks: with their splits.
        parts: of the dataset.
        derivation: how it follows from its sources.
        sources: the datasets that are read.
        label: the dataset's own name.
    """

    name: str
    data_version: int
    runs: tuple[Run, ...]
    tasks: tuple[Task, ...]
    parts: tuple[PlannedPart, ...]
    derivation: Derivation
    sources: tuple[Dataset, ...]
    label: str | None = None

    @property
    def num_cut(self) -> int:
        """Number of parts that are made anew."""
        return sum(part.operation is not None for part in self.parts)

    @property
    def bytes(self) -> int:
        """Size of the archives; of parts that are cut, that of the whole parts."""
        return sum(part.source.entry(part.source_key).size for part in self.parts)


def carry_out(plan: Plan, out: Path, progress: Progress | None = None) -> Manifest:
    """Makes a planned dataset, or finishes one whose making was stopped.

    Raises:
        StoreError: the folder holds something else, a part of a source is damaged, or a source has changed.
        StorageError: the operating system refuses an operation.
        LockedError: another process writes to the folder.
    """
    whole = [part for part in plan.parts if part.operation is None]
    with open_assembly(out, plan.derivation, plan.sources) as assembly:
        assembly.copy(
            [Copied(part.key, part.source, part.source_key) for part in whole],
            progress=None if progress is None else lambda done, _: progress(done, len(plan.parts)),
        )
        made = 0
        for part in plan.parts:
            if part.operation is not None:
                made += 1
                assembly.write(part.key, part.make)
                if progress is not None:
                    progress(len(whole) + made, len(plan.parts))
        return assembly.finish(
            name=plan.name,
            data_version=plan.data_version,
            runs=plan.runs,
            tasks=plan.tasks,
            label=plan.label,
        )


def settle_runs(
    runs: Sequence[Run], keys: Collection[PartKey], tasks: Sequence[Task], *, cut: Collection[str] = ()
) -> tuple[Run, ...]:
    """The runs of a new dataset, one with a recipe first.

    Runs call for their snapshots only if every task has those of every run.

    Args:
        runs: of the sources, under the names of the new dataset.
        keys: of the new dataset's parts.
        tasks: of the new dataset.
        cut: names of runs with parts that were made anew.
    """
    counts: dict[str, int] = {}
    planned = {run.name: frozenset(run.steps or ()) for run in runs}
    for key in keys:
        counts[key.run] = counts.get(key.run, 0) + (key.step in planned[key.run])
    kept = [run for run in runs if run.name in counts]
    if all(run.recipe is None for run in kept):
        kept.insert(0, next(run for run in runs if run.recipe is not None))
    has_all = all(
        run.steps is not None and counts.get(run.name, 0) == len(run.steps) * len(tasks) for run in kept
    )
    return tuple(
        run.model_copy(
            update={
                "steps": run.steps if has_all else None,
                "kind": "subset" if run.name in cut and can_be_made_again(run) else run.kind,
            }
        )
        for run in sorted(kept, key=lambda run: run.recipe is None)
    )


def simulated_run(dataset: Dataset, name: str) -> tuple[Run, Recipe, int]:
    """A run whose parts have keyed seeds, its recipe and its root seed.

    Raises:
        SelectionError: the dataset has no such run.
        BuildError: its parts cannot be simulated again.
    """
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

    Args:
        dataset: that holds them.
        run: theirs.
        keys: theirs.
        policy: whether their policies are needed.
        allow_drift: whether another platform will do.

    Raises:
        BuildError: a part without policy, or with another seed than its run.
        NondeterminismError: a part was made on another platform.
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
    """The parts of a run that a selection leaves, sorted.

    Raises:
        SelectionError: nothing is left.
    """
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

    Args:
        tasks: all tasks.
        chosen: where the pairs start.
        number: of pairs per chosen task.

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
