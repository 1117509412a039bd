"""The best target of an oracle that acts the same in every task: what a method is worth that never adapts."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_algo.algorithms.core.problem import SMALLEST_STD, numbers
from tcmrl_data import Task

FloatArray = npt.NDArray[np.floating]

MOST_EVALUATIONS = 200
"""Of the search for a target; two coordinates take about 80."""


def best_target(
    tasks: Sequence[Task], mean_return: Callable[[Mapping[str, Any]], float]
) -> tuple[dict[str, Any], float]:
    """Task parameters whose oracle does best in all tasks, by a simplex search, and the mean return.

    The search starts at the best of the tasks' own parameters and their mean. Parameters that all tasks
    share stay what they are.

    Args:
        tasks: on which the parameters are fitted.
        mean_return: the mean over the tasks of the returns of the oracle for given parameters.
    """
    from scipy.optimize import minimize

    table = np.array([numbers(task.parameters) for task in tasks])
    varying = table.std(axis=0) > SMALLEST_STD

    def parameters(values: FloatArray) -> dict[str, Any]:
        row = np.where(varying, 0.0, table[0])
        row[varying] = values
        found: dict[str, Any] = with_numbers(tasks[0].parameters, iter(row.tolist()))
        return found

    starts = [*table[:, varying], table[:, varying].mean(axis=0)]
    start = max(starts, key=lambda values: mean_return(parameters(values)))
    found = minimize(
        lambda values: -mean_return(parameters(values)),
        start,
        method="Nelder-Mead",
        options={"maxfev": MOST_EVALUATIONS, "initial_simplex": _simplex(start, table[:, varying])},
    )
    return parameters(found.x), -float(found.fun)


def _simplex(start: FloatArray, table: FloatArray) -> FloatArray:
    """The start and steps from it along every axis, of half a standard deviation over the tasks."""
    return np.concatenate([start[None], start + np.diag(table.std(axis=0) / 2)])


def with_numbers(value: Any, replacements: Iterator[float]) -> Any:
    """The JSON value with its numbers replaced in the order of `leaves`."""
    if isinstance(value, Mapping):
        return {key: with_numbers(value[key], replacements) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [with_numbers(item, replacements) for item in value]
    return next(replacements) if isinstance(value, int | float) else value
