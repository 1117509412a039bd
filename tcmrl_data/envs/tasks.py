"""Tasks of an environment: indices, parameters and the fixed split."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from tcmrl_data.envs.base import Environment
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator

Split = Literal["train", "test"]

PARAMETER_DIGITS = 10
"""Significant decimal digits of a task parameter.

Vectorized functions (`exp`, `pow`, `sin`) and fused multiply-adds differ between instruction sets in the last
of a double's 16 to 17 digits. Ten digits are the same on all of them, and more than a dataset's float32 has.
"""


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
    """Draws all tasks of an environment; depends on its settings only (`task_seed`, not `--seed`).

    Floating-point parameters are rounded to PARAMETER_DIGITS significant digits, so that they are the same
    bits on every processor.
    """
    settings = environment.settings
    drawn = environment.draw_parameters(settings.tasks, settings.task_seed)
    tasks = [Task(index, "train", _rounded(parameters)) for index, parameters in enumerate(drawn)]
    generator = keyed_generator(settings.task_seed, environment.name, NO_TASK, Purpose.SPLIT)
    order = [task.index for task in in_order(environment, tasks)]
    match settings.split:
        case "strata":
            test = draw_from_strata(order, settings.tasks - settings.train, generator)
        case "interpolation":
            test = middles_of_strata(order, settings.tasks - settings.train)
        case "permutation":
            test = set(generator.permutation(settings.tasks)[settings.train :].tolist())
    return tuple(replace(task, split="test") if task.index in test else task for task in tasks)


def in_order(environment: Environment, tasks: Iterable[Task]) -> list[Task]:
    """The tasks sorted by the environment's ordering, or by index if it has none."""
    return sorted(tasks, key=lambda task: (place_in_order(environment, task) or 0.0, task.index))


def place_in_order(environment: Environment, task: Task) -> float | None:
    """The value of the environment's ordering for a task; None if there is none.

    Tasks of imported data may have no parameters, or other ones than the environment draws.
    """
    try:
        return environment.ordering(task.parameters)
    except (LookupError, TypeError, ValueError, OverflowError):
        return None


def draw_from_strata(order: Sequence[int], number: int, generator: np.random.Generator) -> set[int]:
    """Draws one item from each of `number` consecutive strata, whose sizes differ by at most one."""
    return {order[int(generator.integers(start, stop))] for start, stop in _strata(len(order), number)}


def middles_of_strata(order: Sequence[int], number: int) -> set[int]:
    """The middle item of each stratum of `draw_from_strata`."""
    return {order[(start + stop) // 2] for start, stop in _strata(len(order), number)}


def _strata(size: int, number: int) -> Iterator[tuple[int, int]]:
    """Start and stop position of each of `number` strata."""
    return pairwise(stratum * size // number for stratum in range(number + 1))


def _rounded(value: Any) -> Any:
    """A JSON value with all floats rounded."""
    if isinstance(value, float):
        return float(f"{value:.{PARAMETER_DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(member) for key, member in value.items()}
    return [_rounded(member) for member in value] if isinstance(value, list | tuple) else value
