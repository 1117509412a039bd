"""How far the parameters of test tasks lie from those of training tasks."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Task, place_in_order
from tcmrl_data.foundation.errors import TcmrlError

LARGEST = 1e300
"""Numbers from here on are left out; an integer may have more digits than a float."""


@dataclass(frozen=True)
class ParameterShift:
    """One number of the tasks' parameters, in training and in test tasks.

    Attributes:
        parameter: what it is: the environment's ordering, or the dotted place of a number.
        train: mean over the training tasks.
        test: mean over the test tasks.
        difference: test minus train.
        standardized: the difference in standard deviations of the training tasks; None where these are equal
            and the test tasks differ from them.
    """

    parameter: str
    train: float
    test: float
    difference: float
    standardized: float | None


def parameter_shifts(dataset: Dataset) -> list[ParameterShift]:
    """The shift of the environment's ordering, or of every number of the parameters where it has none.

    Numbers that are equal in all tasks are left out. Empty without training or without test tasks.
    """
    splits = (dataset.train_tasks, dataset.test_tasks)
    train, test = ([_numbers(dataset, task) for task in tasks] for tasks in splits)
    if not train or not test:
        return []
    names = [name for name in train[0] if all(name in found for found in (*train, *test))]
    shifts = (
        _shift(name, [found[name] for found in train], [found[name] for found in test]) for name in names
    )
    return [shift for shift in shifts if shift is not None]


def shift_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """The shifts as JSON: `{"parameter", "train", "test", "difference", "standardized"}`."""
    return [asdict(shift) for shift in parameter_shifts(dataset)]


def _shift(name: str, train: Sequence[float], test: Sequence[float]) -> ParameterShift | None:
    if len({*train, *test}) == 1:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # a stranger's numbers may be of any size
        means, scale = (float(np.mean(train)), float(np.mean(test))), float(np.std(train))
        difference = means[1] - means[0]
    if not math.isfinite(difference) or not math.isfinite(scale):
        return None
    return ParameterShift(name, *means, difference, difference / scale if scale > 0 else None)


def _numbers(dataset: Dataset, task: Task) -> dict[str, float]:
    """The task's place in the environment's ordering, or all numbers of its parameters by dotted names."""
    try:
        environment = dataset.environment
    except TcmrlError:  # its package is not installed: what the parameters say is all that is known
        return dict(_flat(task.parameters))
    place = place_in_order(environment, task)
    if place is None or environment.ordering_name is None:
        return dict(_flat(task.parameters))
    return {environment.ordering_name: place}


def _flat(value: Any, place: str = "") -> Iterator[tuple[str, float]]:
    items: Iterator[tuple[Any, Any]] = iter(())
    if isinstance(value, Mapping):
        items = iter(value.items())
    elif isinstance(value, list | tuple):
        items = iter(enumerate(value))
    elif isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST:
        yield place, float(value)
    for name, member in items:
        yield from _flat(member, f"{place}.{name}" if place else str(name))
