"""Episodes of one task with the rewards of another, where the two differ in rewards alone."""

import contextlib
import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import BuildError, SelectionError
from tcmrl_data.operations.apply import (
    Pair,
    check_parts,
    keys_of_run,
    nearest_pairs,
    runs_of_pairs,
    simulated_run,
)
from tcmrl_data.operations.assembly import Plan, Progress, carry_out, check_out, derivation_of
from tcmrl_data.parts.jobs import DeriveSpec
from tcmrl_data.parts.making import wanted_from
from tcmrl_data.parts.operation import Simulator, Sources, StoredPart
from tcmrl_data.parts.own_operations import RELABEL, first_episode_of
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.tables import MAIN_RUN, MAX_RUNS


@dataclass(frozen=True)
class RelabelReport:
    """What a relabelling made, or would make.

    Attributes:
        runs: its runs; each holds one source per task.
    """

    dataset: Path
    runs: tuple[str, ...]
    pairs: int
    parts: int
    steps: int
    root: str | None


def relabel_dataset(
    path: str | Path | Dataset,
    out: str | Path,
    *,
    to: str | Sequence[int],
    tasks: Sequence[int] | None = None,
    snapshots: str = "all",
    of: str = MAIN_RUN,
    run: str = "relabelled",
    allow_test: bool = False,
    label: str | None = None,
    workers: int | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> RelabelReport:
    """Makes a dataset of stored episodes with the rewards that other tasks give for them.

    Every episode is simulated again in the other task, from its stored seed and with its stored actions. Its
    observations must come back bit for bit, so that tasks with other dynamics or other starts are refused. No
    reward function has to be known. The same call goes on after a stop.

    Args:
        out: folder of the new dataset, which holds relabelled parts alone; merge it with the old one for
            both.
        to: indices of the tasks whose rewards are wanted, `all`, or `nearest:K`: from every task to the K
            nearest ones of its split, by parameters.
        tasks: indices of the tasks whose episodes are taken; all training tasks where None.
        of: run whose parts are taken.
        run: name of the new run; what else comes to a task is in runs `<run>-2`, ….
        allow_test: take test tasks too. Training refuses what comes from them, unless its selection allows
            it.
        workers: processes at the same time; one per core where None.
        dry_run: only check, count, and try one part per task; write nothing.

    Raises:
        SelectionError: a test task without `allow_test`, an unknown run, or nothing selected.
        SimulationError: tasks differ in more than rewards; names the first step.
        BuildError: parts whose seeds are not known, more runs than a dataset may have, or a failed worker.
        NondeterminismError: the parts were made on another platform.
        StoreError: `out` holds something else, or a part is damaged.

    Example:
        >>> relabel_dataset("data/half-cheetah-vel", "data/x", to="nearest:3").pairs  # doctest: +SKIP
        240
    """
    dataset = path if isinstance(path, Dataset) else open_dataset(path)
    out = Path(out)
    source, recipe, seed = simulated_run(dataset, of)
    sources = _sources(dataset, tasks, allow_test)
    pairs = _pairs(dataset, sources, to, allow_test)
    keys = keys_of_run(dataset, of, [task.index for task in sources], snapshots)
    origin = {"operation": RELABEL, "of": of}
    template = Run(name=run, kind="relabelled", seed=seed, recipe=recipe, origin=origin, steps=None)
    runs, jobs = runs_of_pairs(pairs, keys, template)
    check_parts(dataset, source, sorted({job.source for job in jobs}), policy=False)
    if len(runs) > MAX_RUNS:
        raise BuildError(f"{out} would have {len(runs)} runs, more than {MAX_RUNS}; choose fewer --to tasks")
    recorded = {
        "to": to if isinstance(to, str) else sorted(set(to)),
        "tasks": sorted(task.index for task in sources),
        "snapshots": snapshots,
        "of": of,
        "run": run,
        "allow_test": allow_test,
    }
    derivation = derivation_of(RELABEL, recorded, [dataset])
    check_out(out, derivation)
    common = {"first_episode": first_episode_of(source)}
    spec = DeriveSpec(dataset.path_on_disk, out, RELABEL, common, recipe, seed, jobs)
    _try_out(dataset, spec)
    steps = sum(dataset.entry(job.source).steps for job in jobs)
    counts = (tuple(found.name for found in runs), len(pairs), len(jobs), steps)
    if dry_run:
        return RelabelReport(out, *counts, None)
    made = {job.key.task for job in jobs}
    targets = [task for task in dataset.tasks if task.index in made]
    plan = Plan(runs, targets, (), derivation, [dataset], label, spec)
    return RelabelReport(out, *counts, carry_out(plan, out, progress, workers=workers).root)


def _sources(dataset: Dataset, tasks: Sequence[int] | None, allow_test: bool) -> list[Task]:
    if tasks is None:
        chosen = dataset.tasks if allow_test else dataset.train_tasks
    else:
        chosen = tuple(dataset.task(index) for index in sorted(set(tasks)))
    _refuse_test(chosen, allow_test)
    return list(chosen)


def _pairs(
    dataset: Dataset, sources: Sequence[Task], to: str | Sequence[int], allow_test: bool
) -> list[Pair]:
    if isinstance(to, str):
        match = re.fullmatch(r"all|nearest:([1-9][0-9]{0,4})", to)
        if match is None:
            raise SelectionError(f"to {to!r}: expected task indices, all, or nearest:K")
        if match[1]:
            return nearest_pairs(dataset.tasks, sources, int(match[1]))
        targets = dataset.tasks if allow_test else dataset.train_tasks
    else:
        targets = tuple(dataset.task(index) for index in sorted(set(to)))
    _refuse_test(targets, allow_test)
    pairs = [
        (source.index, target.index)
        for source in sources
        for target in targets
        if source.index != target.index
    ]
    if not pairs:
        raise SelectionError(
            f"{dataset.path}: no task is left whose rewards would be new; choose other tasks"
        )
    return pairs


def _refuse_test(tasks: Sequence[Task], allow_test: bool) -> None:
    test = [task.index for task in tasks if task.split == "test"]
    if test and not allow_test:
        raise SelectionError(
            f"task {test[0]} is a test task, whose data must not get among those of training tasks; leave it "
            "out, or say --allow-test"
        )


def _try_out(dataset: Dataset, spec: DeriveSpec) -> None:
    """Relabels the first episode that goes to every task, so that most refusals come before any work."""
    firsts = {job.key.task: job for job in reversed(spec.jobs)}
    for index, job in sorted(firsts.items()):
        assert spec.seed is not None
        task, source = dataset.task(index), StoredPart.of(dataset, job.source)
        simulator = Simulator(
            spec.recipe, seed=spec.seed, task=task, environment=dataset.environment, num_lanes=1
        )
        operation = spec.operation_on(dataset, job.source)
        wanted = wanted_from(operation, source, task=task, simulator=simulator)
        with contextlib.closing(simulator):
            operation.episodes(wanted, Sources(simulator, (dataclasses.replace(source, first=1),)))
