"""A build's plan: what follows from a recipe, derived once and handed on."""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from tcmrl_data.behavior.base import BehaviorSource
from tcmrl_data.envs.base import Environment, Task
from tcmrl_data.foundation.errors import TaskError
from tcmrl_data.recipe.recipe import Recipe, choose_tasks, group_tasks
from tcmrl_data.store.part import Platform, this_platform
from tcmrl_data.store.tables import check_plan, task_line

PROCESS_BYTES = 400 * 2**20
"""A worker beside its data: torch, MuJoCo and Zarr take about 310 MB as measured; the rest is margin."""
HOLES = 0.04
"""Share of a set of simulators, as planned, that stays lost with every part; measured on half-cheetah-vel."""
PART_COPIES = 4
"""A part's arrays lie in memory as lane arrays, trajectories, packed rows and files."""


@dataclass(frozen=True)
class BuildPlan:
    """What a build, its driver and its workers share.

    Attributes:
        recipe: the resolved recipe.
        seed: root seed of behavior training and rollouts.
        environment: the recipe's.
        tasks: the tasks to build, ascending by index.
        dropped: indices of tasks that are trained with their group, whose rounding would change without them,
            but of which no parts are made.
    """

    recipe: Recipe
    seed: int
    environment: Environment
    tasks: tuple[Task, ...]
    dropped: frozenset[int] = frozenset()

    @classmethod
    def of_tasks(
        cls, recipe: Recipe, *, seed: int, tasks: Iterable[Task], dropped: Iterable[int] = ()
    ) -> "BuildPlan":
        """The plan of a recipe for tasks that are known already."""
        return cls(recipe, seed, recipe.make_environment(), _ordered(tasks), frozenset(dropped))

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
        recipe: what to build.
        seed: root seed of behavior training and rollouts.
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
    return BuildPlan(recipe, seed, environment, _ordered(chosen), frozenset(dropped))
