"""The steps of a part as flat arrays, and passes over all parts with one part in memory."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.errors import SelectionError, StoreError
from tcmrl_data.store.keys import PartKey
from tcmrl_data.verification.replay import spread_parts

Progress = Callable[[int, int], None]
"""Takes the amount of work that is done, and of all."""

SAMPLED_PARTS = 100
"""Parts, evenly spread over the dataset, from which scales and ranges of values are taken."""


@dataclass(frozen=True)
class PartSteps:
    """All steps of a part, episode after episode.

    Attributes:
        observations: (steps, observation_dim), before the step.
        actions: (steps, action_dim).
        rewards: (steps,).
        next_observations: (steps, observation_dim), after the step.
        lengths: number of steps of every episode.
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    next_observations: FloatArray
    lengths: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.rewards)


def read_steps(dataset: Dataset, key: PartKey) -> PartSteps:
    """The steps of a part, in double precision.

    Raises:
        StoreError: the part is damaged, or a value is not finite.
    """
    trajectories = dataset.trajectories(*key)
    columns = {
        "observations": [trajectory.observations[:-1] for trajectory in trajectories],
        "actions": [trajectory.actions for trajectory in trajectories],
        "rewards": [trajectory.rewards for trajectory in trajectories],
        "next_observations": [trajectory.observations[1:] for trajectory in trajectories],
    }
    arrays = {name: np.concatenate(rows).astype(np.float64) for name, rows in columns.items()}
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise StoreError(
            f"{dataset.file_of(key)}: has values that are not finite; leave it out with `tcmrl-data derive`"
        )
    return PartSteps(**arrays, lengths=tuple(map(len, trajectories)))


def filled_parts(dataset: Dataset) -> list[PartKey]:
    """The keys of all parts that have steps, ascending.

    Raises:
        SelectionError: there is none.
    """
    table = dataset.parts
    keys = [key for key, steps in zip(table, table.columns["steps"], strict=True) if steps]
    if not keys:
        raise SelectionError(f"{dataset.folder} has no steps to measure; build it with `tcmrl-data build`")
    return keys


def sampled_parts(dataset: Dataset) -> Iterator[PartSteps]:
    """The steps of at most SAMPLED_PARTS parts, evenly spread over the dataset."""
    return (read_steps(dataset, key) for key in spread_parts(filled_parts(dataset), SAMPLED_PARTS))


def parts_by_task(dataset: Dataset) -> list[tuple[Task, list[PartKey]]]:
    """The tasks that have parts with steps, and the keys of these parts."""
    keys: dict[int, list[PartKey]] = {}
    for key in filled_parts(dataset):
        keys.setdefault(key.task, []).append(key)
    return [(task, keys[task.index]) for task in dataset.tasks if task.index in keys]


def spread_tasks(tasks: list[Task], number: int) -> list[Task]:
    """At most `number` tasks, evenly spread over all, the first and the last among them."""
    positions = np.linspace(0, len(tasks) - 1, min(number, len(tasks))).round().astype(int)
    return [tasks[position] for position in positions]
