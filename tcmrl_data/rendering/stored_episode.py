"""The stored episode that is to be drawn, and the seed from which it starts again."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import RenderingError, SelectionError
from tcmrl_data.foundation.seeding import Purpose, keyed_seed
from tcmrl_data.operations.cutting import SUBSET, read_cut
from tcmrl_data.operations.derived import read_settings
from tcmrl_data.operations.extension import EXTEND, Extension
from tcmrl_data.operations.relabelling import RELABEL, Relabelling
from tcmrl_data.operations.stored import first_episode_of
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.part_record import Identity


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
    task, position = _seeded_as(dataset, key, identity, number)
    seed = keyed_seed(identity.seed, dataset.name, task, Purpose.ROLLOUT_RESET, key.step, position)
    return StoredEpisode(key, number, dataset.task(key.task).parameters, trajectories[number], seed)


def _seeded_as(dataset: Dataset, key: PartKey, identity: Identity, number: int) -> tuple[int, int]:
    """The task and the number of the episode in the key of its seed.

    A cut of an extended or relabelled part does not say what was cut, but its run does.
    """
    derived, place = identity.derived, str(dataset.file_of(key))
    operation = None if derived is None else derived.get("operation")
    if derived is None:
        return key.task, number
    if operation == EXTEND:
        return key.task, read_settings(Extension, derived, place).first_episode + number
    if operation == RELABEL:
        relabelling = read_settings(Relabelling, derived, place)
        return relabelling.task, relabelling.first_episode + number
    if operation != SUBSET:
        raise RenderingError(f"{place}: how it was made is not known here; draw episodes of another part")
    try:
        _, cut = read_cut(identity)
    except ValueError as error:
        raise RenderingError(f"{place}: identity.derived {error}; run `tcmrl-data verify`") from None
    (run,) = (run for run in dataset.manifest.runs if run.name == key.run)
    task = run.source_of(key.task) if run.kind == "relabelled" else key.task
    position = number if cut.episodes is None else cut.episodes[number]
    return task, first_episode_of(run.origin) + position
