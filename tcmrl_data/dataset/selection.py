"""Some tasks and snapshots of a dataset: what exports, samplers and evaluations read."""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import SelectionError

if TYPE_CHECKING:
    from tcmrl_data.dataset.dataset import Dataset


def chosen_steps(dataset: "Dataset", task: int, rule: str) -> tuple[int, ...]:
    """Snapshot steps of a task that a rule of `Dataset.select` leaves, ascending.

    Raises:
        SelectionError: the task is incomplete, the rule cannot be read, or nothing is left.
    """
    steps = dataset.snapshots(task)
    missing = sorted(set(dataset.manifest.steps) - set(steps))
    if missing:
        raise SelectionError(
            f"{dataset.folder}: task {task} lacks snapshots {missing}; finish it with `tcmrl-data build`"
        )
    match = re.fullmatch(r"all|last|steps>=(\d+)|return>=(0(?:\.\d+)?|1(?:\.0+)?)", rule.replace(" ", ""))
    if match is None:
        raise SelectionError(
            f"snapshots {rule!r}: expected all, last, steps>=N or return>=Q with Q in [0, 1]"
        )
    if rule == "last":
        steps = steps[-1:]
    elif match[1]:
        steps = [step for step in steps if step >= int(match[1])]
    elif match[2]:
        means = {step: dataset.part(task, step).statistics.mean for step in steps}
        threshold = np.quantile(list(means.values()), float(match[2]))
        steps = [step for step in steps if means[step] >= threshold]
    if not steps:
        raise SelectionError(
            f"{dataset.folder}: snapshots {rule!r} leaves nothing of task {task}, "
            f"which has {list(dataset.manifest.steps)}"
        )
    return tuple(steps)


@dataclass(frozen=True)
class Selection:
    """Some tasks and snapshots of a dataset; a view, nothing is loaded.

    Attributes:
        dataset: where it comes from.
        tasks: the selected tasks.
        steps: task index to snapshot steps.
    """

    dataset: "Dataset"
    tasks: tuple[Task, ...]
    steps: dict[int, tuple[int, ...]]

    def trajectories(self, task: int) -> list[Trajectory]:
        """All selected episodes of a task, snapshot by snapshot."""
        return [
            trajectory for step in self.steps[task] for trajectory in self.dataset.trajectories(task, step)
        ]
