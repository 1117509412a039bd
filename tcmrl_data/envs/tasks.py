"""Tasks of an environment: indices, parameters and the fixed split."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from tcmrl_data.envs.base import Environment
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator

Split = Literal["train", "test"]

PARAMETER_DIGITS = 10
"""Significant decimal digits of a task parameter.

Vectorized functions (`exp`, `pow`, `sin`) and fused products differ between instruction sets in the last of a
double's 16 to 17 digits; with ten digits all of them give the same number, which still has more digits than
the float32 values of a dataset.
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

    Floating point parameters are rounded to PARAMETER_DIGITS significant digits, whatever the environment
    draws, so that they are the same bits on every instruction set.
    """
    settings = environment.settings
    parameters = environment.draw_parameters(settings.tasks, settings.task_seed)
    permutation = keyed_generator(settings.task_seed, environment.name, NO_TASK, Purpose.SPLIT).permutation(
        settings.tasks
    )
    train = set(permutation[: settings.train].tolist())
    return tuple(
        Task(index, "train" if index in train else "test", _rounded(parameters[index]))
        for index in range(settings.tasks)
    )


def _rounded(value: Any) -> Any:
    """JSON values with their floats rounded; integers, texts and truth values stay as they are."""
    if isinstance(value, float):
        return float(f"{value:.{PARAMETER_DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(member) for key, member in value.items()}
    return [_rounded(member) for member in value] if isinstance(value, list | tuple) else value
