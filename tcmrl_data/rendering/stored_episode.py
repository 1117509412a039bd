"""The stored episode that is to be drawn, and the seed from which it starts again."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import RenderingError, SelectionError
from tcmrl_data.foundation.seeding import Purpose, keyed_seed
from tcmrl_data.parts.making import operation_of
from tcmrl_data.store.keys import PartKey


@dataclass(frozen=True)
class StoredEpisode:
    """An episode of a dataset.

    Attributes:
        key: of its part.
        number: its position in the part.
        parameters: of its task.
        trajectory: its arrays.
        reset_seed: with which its task was reset.
    """

    key: PartKey
    number: int
    parameters: Mapping[str, Any]
    trajectory: Trajectory
    reset_seed: int

    def __str__(self) -> str:
        return f"{self.key}, episode {self.number}"


def find_episode(dataset: Dataset, key: PartKey, number: int) -> StoredEpisode:
    """Reads an episode.

    Raises:
        SelectionError: the dataset has no such part, or the part no such episode.
        RenderingError: the seed of its reset is not known.
        StoreError: the part is damaged.
    """
    identity = dataset.part(*key).identity
    if identity.seed is None:
        raise RenderingError(
            f"{dataset.path}: the seeds of the episodes of {key} are not known, so that they cannot be "
            "played again; draw episodes of a dataset that was built, not imported or recorded"
        )
    trajectories = dataset.trajectories(*key)
    if number >= len(trajectories):
        raise SelectionError(
            f"{dataset.path}: {key} has {len(trajectories)} episodes; choose --episode below that"
        )
    (run,) = (run for run in dataset.manifest.runs if run.name == key.run)
    operation = operation_of(identity, str(dataset.file_of(key)))
    task, position = operation.seeded_as(key.task, number, run)
    seed = keyed_seed(identity.seed, dataset.name, task, Purpose.ROLLOUT_RESET, key.step, position)
    return StoredEpisode(key, number, dataset.task(key.task).parameters, trajectories[number], seed)
