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

    Parameters that are no numbers are left out where all tasks share them, such as the name of a simulator.

    Args:
        training_tasks: whose means and standard deviations scale.

    Raises:
        TrainingError: a parameter that is no number and differs between tasks.

    Example:
        >>> scaled = TaskParameters(dataset.train_tasks)(dataset.test_tasks)  # doctest: +SKIP
    """

    def __init__(self, training_tasks: Sequence[Task]) -> None:
        self._texts = texts(training_tasks[0].parameters)
        values = self._table(training_tasks)
        self._mean, std = values.mean(dim=0), values.std(dim=0, correction=0)
        self._scale = torch.where(std < SMALLEST_STD, torch.ones_like(std), std)

    def __call__(self, tasks: Sequence[Task]) -> Float[Tensor, "tasks parameters"]:
        """The parameters of some tasks, in units of the training tasks' standard deviations."""
        return ((self._table(tasks) - self._mean) / self._scale).float()

    def _table(self, tasks: Sequence[Task]) -> Tensor:
        for task in tasks:
            found = texts(task.parameters)
            if found != self._texts:
                differing = [value for value in found if value not in self._texts] or found
                raise TrainingError(
                    f"task {task.index} has the parameter {differing[0]!r}, which is no number and not "
                    "that of all tasks; choose a method that needs no task parameters"
                )
        return torch.tensor([numbers(task.parameters) for task in tasks], dtype=torch.float64)


def numbers(parameters: Any) -> list[float]:
    """The numbers of a JSON value, in the order of `leaves`."""
    return [float(leaf) for leaf in leaves(parameters) if isinstance(leaf, int | float)]


def texts(parameters: Any) -> list[Any]:
    """The leaves of a JSON value that are no numbers, in the order of `leaves`."""
    return [leaf for leaf in leaves(parameters) if not isinstance(leaf, int | float)]


def leaves(value: Any) -> Iterator[Any]:
    """The values within a JSON value, depth first; mappings by sorted key."""
    if isinstance(value, Mapping):
        value = [value[key] for key in sorted(value)]
    if isinstance(value, list | tuple):
        for item in value:
            yield from leaves(item)
    else:
        yield value
