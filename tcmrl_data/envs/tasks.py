"""Tasks of an environment: indices, parameters and the fixed split."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from tcmrl_data.envs.base import Environment
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator

Split = Literal["train", "test"]


@dataclass(frozen=True)
class Task:
    """One task of an environment.

    Attributes:
        index: position in the full task set; the same in every profile and selection.
        split: `train` or `test`.
        parameters: JSON values that define the task.
    """

    index: int
    split: Split
    parameters: Mapping[str, Any]


def draw_tasks(environment: Environment) -> tuple[Task, ...]:
    """Draws all tasks of an environment; depends on its settings only (`task_seed`, not `--seed`)."""
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
