"""Task parameters as numbers, for controls that may see them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, final

import torch
from jaxtyping import Float
from torch import Tensor

from tcmrl_data import Task, TrainingError

SMALLEST_STD = 1e-6
"""Parameters that vary less between training tasks are left undivided."""


@final
class TaskParameters:
    """Standardises the parameters of tasks by those of the training tasks.

    Args:
        training_tasks: whose means and standard deviations scale.

    Raises:
        TrainingError: a parameter that is no number.

    Example:
        >>> scaled = TaskParameters(dataset.train_tasks)(dataset.test_tasks)  # doctest: +SKIP
    """

    def __init__(self, training_tasks: Sequence[Task]) -> None:
        values = _table(training_tasks)
        self._mean, std = values.mean(dim=0), values.std(dim=0, correction=0)
        self._scale = torch.where(std < SMALLEST_STD, torch.ones_like(std), std)

    def __call__(self, tasks: Sequence[Task]) -> Float[Tensor, "tasks parameters"]:
        """The parameters of some tasks, in units of the training tasks' standard deviations."""
        return ((_table(tasks) - self._mean) / self._scale).float()


def _table(tasks: Sequence[Task]) -> Tensor:
    return torch.tensor([list(_numbers(task.parameters, task)) for task in tasks], dtype=torch.float64)


def _numbers(value: Any, task: Task) -> Iterator[float]:
    """The numbers of a JSON value, depth first; mappings by sorted key."""
    if isinstance(value, Mapping):
        value = [value[key] for key in sorted(value)]
    if isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item, task)
    elif isinstance(value, int | float):
        yield float(value)
    else:
        raise TrainingError(
            f"task {task.index} has the parameter {value!r}, which is no number; "
            "choose a method that needs no task parameters"
        )
