"""Some tasks and snapshots of a dataset: what exports, samplers and evaluations read."""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tcmrl_data.dataset.tables import Tables
from tcmrl_data.dataset.tiers import tier_parts
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.store.keys import PartKey

if TYPE_CHECKING:
    from tcmrl_data.dataset.dataset import Dataset

_RULE = re.compile(r"all|last|steps>=(\d+)|return>=(0(?:\.\d+)?|1(?:\.0+)?)|tier:(.*)")


def chosen_parts(dataset: Tables, task: int, rule: str) -> tuple[PartKey, ...]:
    """Parts of a task that a rule of `Dataset.select` leaves, sorted by step and run.

    Raises:
        SelectionError: the task is incomplete, the rule cannot be read, or nothing is left.
    """
    missing = [key.step for key in dataset.missing(task)]
    if missing:
        raise SelectionError(
            f"{dataset.folder}: task {task} lacks snapshots {missing}; finish it with `tcmrl-data build`"
        )
    keys = dataset.parts.keys_of(task)
    match = _RULE.fullmatch(rule.replace(" ", ""))
    if match is None:
        raise SelectionError(
            f"snapshots {rule!r}: expected all, last, steps>=N, return>=Q with Q in [0, 1], or tier:NAME"
        )
    chosen = keys
    if rule == "last":
        last = {key.run: key.step for key in keys}
        chosen = [key for key in keys if key.step == last[key.run]]
    elif match[1]:
        chosen = [key for key in keys if key.step >= int(match[1])]
    elif match[2]:
        means = {key: dataset.entry(key).mean for key in keys}
        threshold = np.quantile(list(means.values()), float(match[2]))
        chosen = [key for key in keys if means[key] >= threshold]
    elif match[3] is not None:
        chosen = tier_parts(dataset, task, match[3])
    if not chosen:
        raise SelectionError(
            f"{dataset.folder}: snapshots {rule!r} leaves nothing of task {task}, "
            f"which has {[key.step for key in keys]}"
        )
    return tuple(chosen)


@dataclass(frozen=True)
class Selection:
    """Some tasks and snapshots of a dataset; a view, nothing is loaded.

    Attributes:
        dataset: where it comes from.
        tasks: the selected tasks.
        parts: task index to the keys of its selected parts.
        allow_test: training may use parts that were made from test tasks.
        rule: by which the parts were chosen, such as `all` or `tier:medium`.
    """

    dataset: "Dataset"
    tasks: tuple[Task, ...]
    parts: dict[int, tuple[PartKey, ...]]
    allow_test: bool = False
    rule: str = "all"

    def trajectories(self, task: int) -> list[Trajectory]:
        """All selected episodes of a task, snapshot by snapshot."""
        return [trajectory for key in self.parts[task] for trajectory in self.dataset.trajectories(*key)]

    def parts_from_test(self) -> list[tuple[PartKey, int]]:
        """Parts made from the policy or the episodes of another task that is not for training, and it."""
        runs = {run.name: dict(run.sources) for run in self.dataset.manifest.runs}
        return [
            (key, source)
            for keys in self.parts.values()
            for key in keys
            if (source := runs[key.run].get(key.task)) is not None
            and self.dataset.split_of(source) != "train"
        ]
