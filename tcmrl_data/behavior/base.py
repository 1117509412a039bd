"""Behavior sources make the policies of which a dataset holds rollouts."""

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import BaseModel

from tcmrl_data.behavior.checkpoints import CheckpointFolder
from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.envs.base import Environment, Reward
from tcmrl_data.envs.controller import View
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.plugins import Registry


@dataclass(frozen=True)
class BehaviorContext:
    """What a source needs to make the behavior policies of a unit.

    Attributes:
        environment: the environment whose tasks are trained on.
        tasks: the unit's tasks.
        seed: root seed of the build.
        observation: view that the policies see.
        reward: reward that the policies learn from.
        report: called with the number of environment steps done since the last call.
        checkpoints: where the training of given tasks keeps its state.
    """

    environment: Environment
    tasks: Sequence[Task]
    seed: int
    observation: View
    reward: Reward
    report: Callable[[int], None]
    checkpoints: Callable[[Sequence[Task]], CheckpointFolder]


class BehaviorSource(abc.ABC):
    """Makes the behavior policies of tasks; a plug-in of the entry point group `tcmrl.behavior`.

    Args:
        settings: an instance of `Settings`.
    """

    name: ClassVar[str]
    Settings: ClassVar[type[BaseModel]]
    """The recipe's `[behavior.<name>]` table."""
    extends: ClassVar[str | None] = None
    """The source whose table holds the values that `[behavior.<name>]` leaves out."""

    def __init__(self, settings: BaseModel) -> None:
        self.settings = settings

    @property
    @abc.abstractmethod
    def steps(self) -> tuple[int, ...]:
        """The snapshot steps, ascending."""

    @property
    @abc.abstractmethod
    def training_steps(self) -> int:
        """Environment steps of behavior training per task."""

    @property
    def group_size(self) -> int:
        """Task indices per unit: tasks whose indices give the same quotient by it are trained together."""
        return 1

    @property
    def warmup_steps(self) -> int:
        """Environment steps of a task before its first update."""
        return 0

    def with_warmup(self, steps: int) -> "BehaviorSource":
        """This source with a warm-up of at most so many steps, so that a forecast soon sees updates."""
        return self

    @abc.abstractmethod
    def training_bytes(self, environment: Environment, num_tasks: int) -> int:
        """Most memory that training `num_tasks` tasks takes, beside the process and the simulators."""

    def provenance(self) -> Mapping[str, Any]:
        """What is to be recorded with every part beside the settings; JSON."""
        return {}

    @abc.abstractmethod
    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        """Yields every (task, snapshot) of the unit, each task's in ascending order of steps."""


BEHAVIOR_SOURCES = Registry("tcmrl.behavior", "behavior source", BehaviorSource)
