"""Pairs of tasks: whose policy or episodes go to which task, and in which run the result lies."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import SelectionError

Pair = tuple[int, int]
"""Index of the task that something comes from, and of the task that it goes to."""


def nearest_pairs(tasks: Sequence[Task], chosen: Sequence[Task], number: int) -> list[Pair]:
    """From every chosen task to the nearest other tasks of its split, all nearest ones first.

    Tasks are compared by the Euclidean distance of their parameters, each in units of its standard deviation
    over all tasks; of tasks at equal distances the one with the smaller index is nearer.

    Args:
        tasks: all tasks.
        chosen: where the pairs start.
        number: of pairs per chosen task.

    Raises:
        SelectionError: parameters that are not numbers or not equally many, or too few tasks in a split.
    """
    scaled = _scaled(tasks)
    rows = {task.index: row for row, task in enumerate(tasks)}
    is_test = np.array([task.split == "test" for task in tasks])
    found: list[list[int]] = []
    for task in chosen:
        distances = np.linalg.norm(scaled - scaled[rows[task.index]], axis=1)
        others = np.flatnonzero(is_test == (task.split == "test"))
        others = others[others != rows[task.index]]
        if len(others) < number:
            raise SelectionError(
                f"task {task.index} has {len(others)} other {task.split} tasks, not {number}; "
                "choose fewer neighbours"
            )
        order = others[np.argsort(distances[others], kind="stable")[:number]]
        found.append([tasks[row].index for row in order])
    return [
        (task.index, near[rank]) for rank in range(number) for task, near in zip(chosen, found, strict=True)
    ]


def runs_of_pairs(pairs: Iterable[Pair], run: str) -> dict[Pair, str]:
    """The runs in which the parts of pairs lie, so that no two of a task have the same key.

    The first pair that goes to a task is in `run`, the second one in `run-2`, and so on.
    """
    counts: dict[int, int] = {}
    runs = {}
    for source, target in pairs:
        counts[target] = counts.get(target, 0) + 1
        runs[source, target] = run if counts[target] == 1 else f"{run}-{counts[target]}"
    return runs


def _scaled(tasks: Sequence[Task]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Parameters of the tasks in units of their standard deviations, (tasks, parameters)."""
    rows = [list(_numbers(task.parameters, task)) for task in tasks]
    if len({len(row) for row in rows}) != 1 or not rows[0]:
        raise SelectionError("the tasks do not have equally many parameters, so none is near another")
    values = np.array(rows, dtype=np.float64)
    spread = values.std(axis=0)
    return values / np.where(spread > 0, spread, 1.0)


def _numbers(value: Any, task: Task) -> Iterable[float]:
    if isinstance(value, Mapping):
        for key in sorted(value):
            yield from _numbers(value[key], task)
    elif isinstance(value, list | tuple):
        for member in value:
            yield from _numbers(member, task)
    elif isinstance(value, int | float):
        yield float(value)
    else:
        raise SelectionError(f"task {task.index} has a parameter that is no number, so none is near it")
