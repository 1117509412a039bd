"""Packed rows: all selected steps in one float32 table."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.base import DENSE_REWARDS, Reward
from tcmrl_data.foundation.errors import SelectionError, StoreError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.store.arrays import Arrays, array_digests, checked_offsets
from tcmrl_data.store.keys import PartKey

if TYPE_CHECKING:
    from tcmrl_data.dataset.dataset import Dataset
    from tcmrl_data.dataset.selection import Selection

Indices = npt.NDArray[np.int64]
Table = npt.NDArray[np.float32]

ROW_ARRAYS = ("observations", "actions", "rewards", "terminated", "episode_offsets")
READERS = 8
"""Maximum number of parts that are read at the same time; limits memory."""


@dataclass(frozen=True)
class Episodes:
    """Positions of a selection's episodes, without episodes that have no step.

    Attributes:
        starts: (episodes,) first row of every episode.
        lengths: (episodes,) number of steps, at least 1.
        task_ranges: (tasks, 2) first episode and last episode + 1 of every task.
    """

    starts: Indices
    lengths: Indices
    task_ranges: Indices

    @classmethod
    def of(cls, lengths: Sequence[Indices], tasks: Sequence[int]) -> "Episodes":
        """The positions of episodes with consecutive rows.

        Args:
            lengths: per part, the lengths of its episodes.
            tasks: per part, the position of its task; ascending.
        """
        flat = np.concatenate(lengths)
        starts = np.cumsum(flat + 1) - flat - 1
        owner = np.repeat(tasks, [len(part) for part in lengths])[flat > 0]
        positions = np.arange(max(tasks) + 1)
        ranges = np.stack([np.searchsorted(owner, positions, side) for side in ("left", "right")], axis=1)
        return cls(starts[flat > 0], flat[flat > 0], ranges.astype(np.int64))

    @property
    def longest(self) -> int:
        """Number of steps of the longest episode; 0 if there are no episodes."""
        return int(self.lengths.max(initial=0))


@dataclass(frozen=True)
class PackedRows:
    """All steps of a selection; a row is (observation, action, reward, terminated).

    If dense rewards are loaded, they are a further column. An episode of T steps has T + 1 rows, so that the
    next observation is in the next row; the last row of an episode holds an observation and zeros. After the
    last episode follow at least as many rows of zeros as the longest episode has steps, so that a block of
    that length can start at any episode.

    Attributes:
        table: (rows, observation_dim + action_dim + 2), or one column more with dense rewards.
        episodes: positions of the episodes in the table.
        observation_dim: width of observations.
        action_dim: width of actions.
        task_indices: (tasks,) indices of the tasks.
    """

    table: Table
    episodes: Episodes
    observation_dim: int
    action_dim: int
    task_indices: Indices

    @property
    def has_dense(self) -> bool:
        """Whether dense rewards are loaded."""
        return bool(self.table.shape[1] > self.terminated_column + 1)

    @property
    def terminated_column(self) -> int:
        """Column of the flags."""
        return self.observation_dim + self.action_dim + 1

    def reward_column(self, rewards: Reward) -> int:
        """Column of the stored or of the dense rewards."""
        return self.terminated_column + (1 if rewards == "dense" else -1)


@dataclass(frozen=True)
class PartRows:
    """The rows of one part.

    Attributes:
        dataset: the dataset.
        key: the part.
        task: position of the part's task in the selection.
        first: its first row.
        last: its last row + 1.
        episodes: number of its episodes.
        dense: whether its dense rewards are read.
    """

    dataset: "Dataset"
    key: PartKey
    task: int
    first: int
    last: int
    episodes: int
    dense: bool = False


def plan_rows(selection: "Selection", *, dense: bool = False) -> list[PartRows]:
    """Plans the rows of a selection's parts, with dense rewards or without; opens no part."""
    plan, first = [], 0
    for position, task in enumerate(selection.tasks):
        for key in selection.parts[task.index]:
            entry = selection.dataset.entry(key)
            last = first + entry.steps + entry.episodes  # an episode has one row more than steps
            plan.append(PartRows(selection.dataset, key, position, first, last, entry.episodes, dense))
            first = last
    return plan


def table_shape(selection: "Selection", plan: Sequence[PartRows]) -> tuple[int, int]:
    """Shape of a selection's table; its padding is as long as the largest part, hence as any episode."""
    environment = selection.dataset.environment
    padding = max(part.last - part.first for part in plan)
    width = environment.observation_dim + environment.action_dim + 2 + plan[0].dense
    return plan[-1].last + padding, width


def read_rows(selection: "Selection", *, dense: bool = False) -> PackedRows:
    """Reads a selection into memory, with dense rewards or without.

    Raises:
        SelectionError: a part has no dense rewards.
        StoreError: arrays cannot be decoded or do not form episodes; the message names the part.
    """
    plan = plan_rows(selection, dense=dense)
    table: Table = np.zeros(table_shape(selection, plan), dtype=np.float32)
    lengths = list(map_parts(plan, lambda part: read_part(part, table[part.first : part.last])))
    return selection_rows(selection, table, Episodes.of(lengths, [part.task for part in plan]))


def selection_rows(selection: "Selection", table: Table, episodes: Episodes) -> PackedRows:
    """The packed rows of a selection, given the filled table."""
    environment = selection.dataset.environment
    indices = np.array([task.index for task in selection.tasks], dtype=np.int64)
    return PackedRows(table, episodes, environment.observation_dim, environment.action_dim, indices)


def map_parts(plan: Sequence[PartRows], read: Callable[[PartRows], Any]) -> Iterator[Any]:
    """Yields the results of `read` for all parts, in order; several threads read at the same time."""
    with ThreadPoolExecutor(min(READERS, available_cores())) as pool:
        yield from pool.map(read, plan)


def read_part(part: PartRows, out: Table, *, check_digests: bool = False) -> Indices:
    """Reads a part into rows of zeros; returns the lengths of its episodes.

    Args:
        part: the part.
        out: (observations, width), the part's rows.
        check_digests: hash the decoded arrays and compare them with the part's record; for rows that others
            receive under the part's id.

    Raises:
        SelectionError: the part has no dense rewards, and they are to be read.
        StoreError: arrays cannot be decoded, do not form episodes, or are not those of the part's record;
            the message names the part.
    """
    if part.dense:
        _check_dense(part)
    arrays = part.dataset.arrays(*part.key, names=row_arrays(part.dense))
    if check_digests:
        _check_digests(part, arrays)
    try:
        return fill_rows(out, arrays)
    except StoreError as error:
        raise StoreError(f"{part.dataset.file_of(part.key)}: {error}; run `tcmrl-data repair`") from None


def row_arrays(dense: bool) -> tuple[str, ...]:
    """The arrays that rows are made of."""
    return (*ROW_ARRAYS, DENSE_REWARDS) if dense else ROW_ARRAYS


def _check_dense(part: PartRows) -> None:
    record = part.dataset.part(*part.key).identity.arrays.get(DENSE_REWARDS)
    if record is None or record.dtype != "float32":
        raise SelectionError(
            f"{part.dataset.path}: the part of {part.key} has no dense rewards beside its rewards; take the "
            'stored ones (rewards = "stored")'
        )


def _check_digests(part: PartRows, arrays: Arrays) -> None:
    records = part.dataset.part(*part.key).identity.arrays
    for name, found in array_digests(arrays).items():
        record = records[name]
        if found != {"dtype": record.dtype, "shape": list(record.shape), "sha256": record.sha256}:
            raise StoreError(
                f"{part.dataset.file_of(part.key)}: {name} is not the array that part.json records; "
                "run `tcmrl-data repair`"
            )


def fill_rows(out: Table, arrays: Arrays) -> Indices:
    """Writes a part's arrays into rows of zeros; returns the lengths of its episodes.

    Args:
        out: (observations, width), the part's rows.
        arrays: the part's arrays.

    Raises:
        StoreError: the arrays do not form episodes, or do not have the shape of `out`.
    """
    observations, actions = arrays["observations"], arrays["actions"]
    dense = [name for name in arrays if name == DENSE_REWARDS]
    columns = out.shape[1] - 2 - len(dense)
    if observations.shape[1] + actions.shape[1] != columns:
        raise StoreError(
            f"observations and actions are {observations.shape[1]} and {actions.shape[1]} wide, the "
            f"environment's take {columns} columns"
        )
    offsets = checked_offsets(arrays["episode_offsets"], len(actions))
    lengths = np.diff(offsets)
    if len(observations) != len(actions) + len(lengths) or len(observations) != len(out):
        raise StoreError(
            f"{len(observations)} observations do not fit {len(actions)} actions in {len(lengths)} episodes"
        )
    scalars = ("rewards", "terminated", *dense)
    for name in scalars:
        if len(arrays[name]) != len(actions):
            raise StoreError(f"{name} has {len(arrays[name])} steps, actions have {len(actions)}")
    observation_dim = observations.shape[1]
    # an episode has one row more than steps
    steps = np.arange(len(actions)) + np.repeat(np.arange(len(lengths)), lengths)
    out[:, :observation_dim] = observations
    out[steps, observation_dim:columns] = actions
    for column, name in enumerate(scalars, start=columns):
        out[steps, column] = arrays[name]
    return lengths
