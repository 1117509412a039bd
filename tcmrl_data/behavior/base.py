"""The public module for a behavior plug-in: base class of the sources of policies that collect data.

The names of snapshots, checkpoints and tasks are repeated here.
"""

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import BaseModel

from tcmrl_data.behavior.checkpoints import CheckpointFolder, TrainingState
from tcmrl_data.behavior.snapshot import GaussianDescription, ScriptedDescription, Snapshot
from tcmrl_data.envs.base import Environment, Reward, View
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.plugins import Registry

__all__ = [
    "BEHAVIOR_SOURCES",
    "BehaviorContext",
    "BehaviorSource",
    "CheckpointFolder",
    "Environment",
    "GaussianDescription",
    "Reward",
    "ScriptedDescription",
    "Snapshot",
    "Task",
    "TrainingState",
    "View",
]


@dataclass(frozen=True)
class BehaviorContext:
    """What a source receives to make the policies of a unit, the tasks that are trained together.

    Attributes:
        seed: root seed of the build.
        observation: the view that policies receive.
        reward: the reward that they are trained on.
        report: called with the number of environment steps since the last call.
        checkpoints: returns the checkpoint folder for a training of some tasks.
    """

    environment: Environment
    tasks: Sequence[Task]
    seed: int
    observation: View
    reward: Reward
    report: Callable[[int], None]
    checkpoints: Callable[[Sequence[Task]], CheckpointFolder]


class BehaviorSource(abc.ABC):
    """Makes the behavior policies of tasks; a plug-in of the entry point group `tcmrl.behavior`."""

    name: ClassVar[str]
    Settings: ClassVar[type[BaseModel]]
    """Class of the recipe's `[behavior.<name>]` table."""
    extends: ClassVar[str | None] = None
    """Name of the source whose table gives the defaults of `[behavior.<name>]`."""

    def __init__(self, settings: BaseModel) -> None:
        self.settings = settings

    @property
    @abc.abstractmethod
    def steps(self) -> tuple[int, ...]:
        """The snapshot steps, in ascending order."""

    @property
    @abc.abstractmethod
    def training_steps(self) -> int:
        """Environment steps of behavior training per task."""

    @property
    def group_size(self) -> int:
        """Task indices per unit: tasks with the same `index // group_size` are trained together."""
        return 1

    @property
    def warmup_steps(self) -> int:
        """Environment steps of a task before its first update."""
        return 0

    def with_warmup(self, steps: int) -> "BehaviorSource":
        """This source with at most `steps` warm-up steps, for estimates that measure the time of updates."""
        return self

    @abc.abstractmethod
    def training_bytes(self, environment: Environment, num_tasks: int) -> int:
        """Maximum memory in bytes for training `num_tasks` tasks, without the process and the simulators."""

    def provenance(self) -> Mapping[str, Any]:
        """Further JSON values to record in the provenance of every part."""
        return {}

    @abc.abstractmethod
    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        """Yields (task, snapshot) for all snapshots of the unit, in ascending order of steps per task."""


BEHAVIOR_SOURCES = Registry("tcmrl.behavior", "behavior source", BehaviorSource)
