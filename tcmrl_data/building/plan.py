"""A build's plan and its units: a worker trains a unit's policies, rolls them out and publishes parts."""

import contextlib
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from tcmrl_data.behavior.base import (
    CHECKPOINT_SECONDS,
    BehaviorContext,
    BehaviorSource,
    CheckpointFolder,
    Snapshot,
    checkpoint_name,
)
from tcmrl_data.engine.local import Send
from tcmrl_data.envs.base import Environment, Task
from tcmrl_data.foundation.errors import NondeterminismError, TaskError
from tcmrl_data.foundation.records import Record, digest, from_json
from tcmrl_data.parts.making import Published, make_part, one_thread, publish, read_published
from tcmrl_data.parts.operation import Simulator, Sources, WantedPart
from tcmrl_data.parts.own_operations import Rollout, measure_references
from tcmrl_data.recipe.recipe import Recipe, choose_tasks, group_tasks
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.part import (
    DATA_VERSION,
    PartRecord,
    Platform,
    References,
    read_part_record,
    this_platform,
)
from tcmrl_data.store.tables import MAIN_RUN, PartKey, check_plan, part_file, task_line

PROCESS_BYTES = 400 * 2**20
"""A worker beside its data: torch, MuJoCo and Zarr take about 310 MB as measured; the rest is margin."""
HOLES = 0.04
"""Share of a set of simulators, as planned, that stays lost with every part; measured on half-cheetah-vel."""
PART_COPIES = 4
"""A part's arrays lie in memory as lane arrays, trajectories, packed rows and files."""


@dataclass(frozen=True)
class BuildPlan:
    """What a build, its driver and its workers share; without what is made of it, it goes to workers as JSON.

    Attributes:
        tasks: the tasks to build, ascending by index.
        dropped: indices of tasks that are trained with their group, whose rounding would change without them,
            but of which no parts are made.
    """

    recipe: Recipe
    seed: int
    tasks: tuple[Task, ...]
    dropped: frozenset[int] = frozenset()

    @functools.cached_property
    def environment(self) -> Environment:
        return self.recipe.make_environment()

    @functools.cached_property
    def wanted(self) -> tuple[Task, ...]:
        """The tasks of which parts are made."""
        return tuple(task for task in self.tasks if task.index not in self.dropped)

    def with_recorded(self, tasks: Iterable[Task], *, dropped: Iterable[int]) -> "BuildPlan":
        """The same plan with the tasks that a dataset has already, as they stand there.

        Args:
            tasks: the dataset's; they replace tasks of this plan.
            dropped: indices of those that the dataset has dropped.
        """
        recorded = {task.index: task for task in tasks}
        own = {task.index: task for task in self.tasks}
        return replace(
            self, tasks=_ordered((own | recorded).values()), dropped=self.dropped | frozenset(dropped)
        )

    def check_limits(self) -> None:
        """Checks that the dataset will not become larger than readers allow.

        Raises:
            BuildError: names the limit and what exceeds it.
        """
        check_plan(
            tasks=len(self.tasks),
            steps=len(self.source.steps),
            columns=max(self.environment.observation_dim, self.environment.action_dim),
            largest_task=max(len(task_line(task)) for task in self.tasks),
        )

    @functools.cached_property
    def source(self) -> BehaviorSource:
        """The recipe's behavior source; made when it is needed, since a replay needs none."""
        return self.recipe.make_source()

    @functools.cached_property
    def groups(self) -> tuple[tuple[Task, ...], ...]:
        """The tasks, those of one unit together."""
        return tuple(group_tasks(self.tasks, self.source.group_size))

    @functools.cached_property
    def platform(self) -> Platform:
        """The platform of this process for the plan's environment and behavior source."""
        return this_platform(self.environment, self.recipe.behavior.source)

    def context(
        self, report: Callable[[int], None], checkpoints: Callable[[Sequence[Task]], CheckpointFolder]
    ) -> BehaviorContext:
        """What the behavior source receives to make the policies of the tasks."""
        behavior = self.recipe.behavior
        return BehaviorContext(
            self.environment,
            self.tasks,
            self.seed,
            behavior.observation,
            behavior.reward,
            report,
            checkpoints,
        )

    @property
    def part_bytes(self) -> int:
        """Size of a part's arrays before compression, for episodes of full length."""
        row_bytes = 4 * (self.environment.observation_dim + self.environment.action_dim + 1) + 2
        return self.recipe.rollouts.episodes * (self.environment.settings.horizon + 1) * row_bytes

    def unit_bytes(self, num_tasks: int) -> int:
        """Most memory that the process of a unit of `num_tasks` tasks is planned to take."""
        lanes = self.recipe.rollouts.lanes
        # closed lanes are freed late, by the garbage collector, and leave holes in the heap
        simulators = num_tasks + 2 * lanes + HOLES * lanes * num_tasks * len(self.source.steps)
        return (
            PROCESS_BYTES
            + self.source.training_bytes(self.environment, num_tasks)
            + int(simulators * self.environment.simulator_bytes)
            + PART_COPIES * self.part_bytes
        )


def _ordered(tasks: Iterable[Task]) -> tuple[Task, ...]:
    return tuple(sorted(tasks, key=lambda task: task.index))


def plan_build(
    recipe: Recipe, *, seed: int = 0, tasks: Sequence[int] | None = None, dropped: Sequence[int] = ()
) -> BuildPlan:
    """The plan of a build.

    Args:
        tasks: indices of the full task set instead of the profile's choice.
        dropped: indices of tasks of which no parts are made.

    Raises:
        TaskError: an index outside the task set, or a task that is both named and dropped.
    """
    both = {*(tasks or ())} & {*dropped}
    if both:
        raise TaskError(f"task {min(both)} is to be built and to be dropped; name it once")
    environment = recipe.make_environment()
    chosen = choose_tasks(recipe, tasks, environment=environment)
    if dropped:
        others = choose_tasks(
            recipe, sorted({*dropped} - {task.index for task in chosen}), environment=environment
        )
        chosen += others
    return BuildPlan(recipe, seed, _ordered(chosen), frozenset(dropped))


@dataclass(frozen=True)
class UnitSpec:
    """What a worker is told, as JSON: the plan of the unit's tasks, which are trained together."""

    dataset: Path
    plan: BuildPlan
    checkpoint_seconds: float = CHECKPOINT_SECONDS


def run_unit(spec: UnitSpec, report: Send) -> str:
    """Makes every missing part of the unit's tasks; parts already published are left alone.

    Returns:
        A digest over the ids of the unit's parts.

    Raises:
        NondeterminismError: a part published on an equal platform has another policy.
    """
    plan = spec.plan
    keys = [PartKey(task.index, step) for task in plan.wanted for step in plan.source.steps]
    missing: dict[int, list[int]] = {}
    for key in keys:
        if not (spec.dataset / part_file(key)).exists():
            missing.setdefault(key.task, []).append(key.step)
    if missing:
        _make_parts(spec, missing, report)
    return digest([_part_id(spec.dataset / part_file(key)) for key in keys])


@final
class PartMaker:
    """Rolls out and publishes the snapshots of one task, with one simulator."""

    def __init__(self, dataset: Path, plan: BuildPlan, *, task: Task, behavior: Mapping[str, Any]) -> None:
        self._dataset, self._behavior = dataset, behavior
        self._simulator = Simulator(
            plan.recipe, seed=plan.seed, task=task, environment=plan.environment, platform=plan.platform
        )
        self._references: References | None = None

    def close(self) -> None:
        """Frees the simulator; closing twice does no harm."""
        self._simulator.close()

    def publish(self, snapshot: Snapshot) -> Published | None:
        """Publishes the part of a snapshot; one that is there already is left alone, and None is returned.

        Raises:
            NondeterminismError: the part that is there was made on an equal platform from another policy.
        """
        simulator = self._simulator
        key = PartKey(simulator.task.index, snapshot.step)
        file = self._dataset / part_file(key)
        if not file.exists():
            return publish(self._dataset, key, lambda: self._make(snapshot))
        _, record = read_published(file, MAIN_RUN)
        same_platform = record.platform.digest() == simulator.platform.digest()
        if same_platform and record.identity.policy != snapshot.digest():
            raise NondeterminismError(
                f"{file}: its policy differs from the one trained now with the same seed"
            )
        return None

    def _make(self, snapshot: Snapshot) -> tuple[PartRecord, bytes]:
        simulator = self._simulator
        settings = simulator.recipe.unit_settings()
        wanted = WantedPart(settings, simulator.task, snapshot.step, simulator.seed, snapshot)
        episodes = Rollout(Record()).make(wanted, Sources(simulator))
        if self._references is None:
            self._references = measure_references(simulator)
        return make_part(
            wanted,
            episodes,
            references=self._references,
            behavior=self._behavior,
            platform=simulator.platform,
        )


def _part_id(file: Path) -> str:
    with Archive(file) as archive:
        return read_part_record(archive).id


def _make_parts(spec: UnitSpec, missing: Mapping[int, Sequence[int]], report: Send) -> None:
    plan, source = spec.plan, spec.plan.source
    context = plan.context(
        lambda count: report({"kind": "steps", "count": count}),
        lambda tasks: _checkpoints(spec, tasks, missing, report),
    )
    recorded = source.provenance()
    with contextlib.ExitStack() as stack:
        makers: dict[int, PartMaker] = {}
        for task, snapshot in source.snapshots(context):
            if task.index not in missing:
                continue
            if task.index not in makers:
                makers[task.index] = PartMaker(spec.dataset, plan, task=task, behavior=recorded)
                stack.callback(makers[task.index].close)
            published = makers[task.index].publish(snapshot)
            if published is not None:
                report(published.to_message())
            # simulators of many tasks would fill the memory: a group makes them anew for every part
            if snapshot.step == source.steps[-1] or len(missing) > 1:
                makers[task.index].close()
    _checkpoints(spec, plan.tasks, missing, report).clear()


def _checkpoints(
    spec: UnitSpec, tasks: Sequence[Task], missing: Mapping[int, Sequence[int]], report: Send
) -> CheckpointFolder:
    """Where the tasks' training keeps its state; bound to everything that the training depends on."""
    key = {
        "data_version": DATA_VERSION,
        "settings": spec.plan.recipe.unit_settings(),
        "seed": spec.plan.seed,
        "tasks": [task.index for task in tasks],
        "platform": spec.plan.platform.digest(),
    }
    return CheckpointFolder(
        spec.dataset,
        checkpoint_name(tasks),
        key=digest(key),
        missing={task.index: missing[task.index][0] for task in tasks if task.index in missing},
        seconds=spec.checkpoint_seconds,
        warn=lambda message: report({"kind": "warning", "message": message}),
    )


def work(spec: dict[str, Any], report: Send) -> str:
    """Makes and publishes the parts of a unit; the digest of their ids."""
    with one_thread():
        return run_unit(from_json(UnitSpec, spec), report)
