"""Tasks of an environment: indices, parameters, and the split that never moves."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from tcmrl_data.envs.base import Environment
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator

Split = Literal["train", "test"]


@dataclass(frozen=True)
class Task:
    """One member of an environment.

    Attributes:
        index: position in the full task set; means the same task in every profile and selection.
        split: `train` or `test`.
        parameters: JSON values that rebuild the task without drawing anything again.
    """

    index: int
    split: Split
    parameters: Mapping[str, Any]


def draw_tasks(environment: Environment) -> tuple[Task, ...]:
    """All tasks of an environment, a function of its settings alone (its `task_seed`, never `--seed`)."""
    settings = environment.settings
    parameters = environment.draw_parameters(settings.tasks, settings.task_seed)
    permutation = keyed_generator(settings.task_seed, environment.name, NO_TASK, Purpose.SPLIT).permutation(
        settings.tasks
    )
    train = set(permutation[: settings.train].tolist())
    return tuple(
        Task(index, "train" if index in train else "test", parameters[index])
        for index in range(settings.tasks)
    )
