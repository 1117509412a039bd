"""Packed rows: all selected steps in one float32 table, and statistics of them."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.base import DENSE_REWARDS, Reward
from tcmrl_data.foundation.errors import SelectionError, StoreError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.store.arrays import Arrays, array_digests, checked_offsets
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    from tcmrl_data.dataset.dataset import Dataset
    from tcmrl_data.dataset.selection import Selection

Indices = npt.NDArray[np.int64]
Table = npt.NDArray[np.float32]
Values = npt.NDArray[np.float64]

ROW_ARRAYS = ("observations", "actions", "rewards", "terminated", "episode_offsets")
READERS = 8
"""Maximum number of parts that are read at the same time; limits memory."""

CHUNK_ROWS = 2**16
"""Rows that are taken to double precision together."""

SMALLEST_STD = 1e-6


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
    def of(cls, lengths: Indices, tasks: Indices) -> "Episodes":
        """The positions of episodes with consecutive rows.

        Args:
            lengths: (episodes,) number of steps, 0 too.
            tasks: (episodes,) positions of their tasks, ascending.
        """
        starts = np.cumsum(lengths + 1) - lengths - 1
        owner = tasks[lengths > 0]
        positions = np.arange(tasks[-1] + 1)
        ranges = np.stack([np.searchsorted(owner, positions, side) for side in ("left", "right")], axis=1)
        return cls(starts[lengths > 0], lengths[lengths > 0], ranges.astype(np.int64))

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
    """Rows `first` to `last` - 1 of a table: those of one part, with dense rewards or without.

    Attributes:
        task: position of the part's task in the selection.
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
    """Reads a selection into memory, with dense rewards or without; raises what `fill_table` does."""
    plan = plan_rows(selection, dense=dense)
    table: Table = np.zeros(table_shape(selection, plan), dtype=np.float32)
    return pack_rows(selection, plan, table, fill_table(table, plan))


def pack_rows(selection: "Selection", plan: Sequence[PartRows], table: Table, lengths: Indices) -> PackedRows:
    """The packed rows of a selection, given the filled table and the lengths of all episodes."""
    environment = selection.dataset.environment
    tasks = np.repeat([part.task for part in plan], [part.episodes for part in plan])
    indices = np.array([task.index for task in selection.tasks], dtype=np.int64)
    episodes = Episodes.of(lengths, tasks)
    return PackedRows(table, episodes, environment.observation_dim, environment.action_dim, indices)


def fill_table(table: Table, plan: Sequence[PartRows], *, check_digests: bool = False) -> Indices:
    """Reads parts into a table of zeros, several at a time; returns the lengths of all episodes.

    Args:
        check_digests: compare the decoded arrays with the digests of the parts' records; for rows that others
            receive under the parts' ids.

    Raises:
        SelectionError: a part has no dense rewards, and they are to be read.
        StoreError: arrays cannot be decoded, do not form episodes, or are not those of the part's record;
            the message names the part.
    """
    for part in plan[:1]:
        part.dataset.fetch(part.key for part in plan)
    with ThreadPoolExecutor(min(READERS, available_cores())) as pool:
        lengths = pool.map(
            lambda part: read_part(part, table[part.first : part.last], check_digests=check_digests), plan
        )
        return np.concatenate(list(lengths))


def read_part(part: PartRows, out: Table, *, check_digests: bool) -> Indices:
    """Reads a part into rows of zeros, as `fill_table` does; returns the lengths of its episodes."""
    if part.dense:
        _check_dense(part)
    arrays = part.dataset.arrays(*part.key, names=row_arrays(part.dense))
    if check_digests:
        _check_digests(part, arrays)
    try:
        lengths = fill_rows(out, arrays)
        if len(lengths) != part.episodes:
            raise StoreError(f"{len(lengths)} episodes instead of {part.episodes}")
    except StoreError as error:
        raise StoreError(
            f"{part.dataset.file_of(part.key)}: {error}; run `tcmrl-data verify --repair`"
        ) from None
    return lengths


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
                "run `tcmrl-data verify --repair`"
            )


def fill_rows(out: Table, arrays: Arrays) -> Indices:
    """Writes a part's arrays into its rows (observations, width) of zeros; returns the episodes' lengths.

    The arrays have the shapes of the part's record, which fit each other.

    Raises:
        StoreError: the offsets are none of episodes, or the arrays do not have the shape of `out`.
    """
    observations, actions = arrays["observations"], arrays["actions"]
    dense = [name for name in arrays if name == DENSE_REWARDS]
    columns = out.shape[1] - 2 - len(dense)
    if observations.shape[1] + actions.shape[1] != columns:
        raise StoreError(
            f"observations and actions are {observations.shape[1]} and {actions.shape[1]} wide, the "
            f"environment's take {columns} columns"
        )
    if len(observations) != len(out):
        raise StoreError(f"{len(observations)} observations, the table of parts calls for {len(out)}")
    lengths: Indices = np.diff(checked_offsets(arrays["episode_offsets"], len(actions)))
    # an episode has one row more than steps
    steps = np.arange(len(actions)) + np.repeat(np.arange(len(lengths)), lengths)
    out[:, : observations.shape[1]] = observations
    out[steps, observations.shape[1] : columns] = actions
    for column, name in enumerate(("rewards", "terminated", *dense), start=columns):
        out[steps, column] = arrays[name]
    return lengths


@dataclass(frozen=True)
class Moments:
    """Statistics of the selected transitions, float64; standard deviations are at least 1e-6.

    Attributes:
        observation_mean, observation_std: (observation_dim,).
        delta_mean, delta_std: (observation_dim,), for next observation minus observation.
        action_mean, action_std: (action_dim,).
        reward_mean, reward_std, reward_min, reward_max: statistics of the reward per step.
        dense_reward_range: smallest and largest dense reward per step; None if dense rewards are not loaded.
        longest_episode: length of the longest episode in steps.
    """

    observation_mean: Values
    observation_std: Values
    delta_mean: Values
    delta_std: Values
    action_mean: Values
    action_std: Values
    reward_mean: float
    reward_std: float
    reward_min: float
    reward_max: float
    longest_episode: int
    dense_reward_range: tuple[float, float] | None = None


def moments_of(rows: PackedRows) -> Moments:
    """Statistics of all transitions of the rows, computed in double precision."""
    table, episodes = rows.table, rows.episodes
    stop = int(episodes.starts[-1] + episodes.lengths[-1])
    width, flags = rows.observation_dim, rows.terminated_column
    total = _Sums(2 * rows.observation_dim + rows.action_dim + 1 + rows.has_dense)
    for first in range(0, stop, CHUNK_ROWS):
        last = min(first + CHUNK_ROWS, stop)
        kept = _is_step(episodes, first, last)
        values = table[first:last][kept].astype(np.float64)
        following = table[first + 1 : last + 1, :width][kept]
        columns = (following - values[:, :width], values[:, :flags], values[:, flags + 1 :])
        total.add(np.concatenate(columns, axis=1))
    mean, std = total.mean, total.std
    delta, observation = slice(0, width), slice(width, 2 * width)
    action, reward = slice(2 * width, width + flags - 1), width + flags - 1
    dense = (float(total.least[-1]), float(total.most[-1])) if rows.has_dense else None
    return Moments(
        observation_mean=mean[observation],
        observation_std=std[observation],
        delta_mean=mean[delta],
        delta_std=std[delta],
        action_mean=mean[action],
        action_std=std[action],
        reward_mean=float(mean[reward]),
        reward_std=float(std[reward]),
        reward_min=float(total.least[reward]),
        reward_max=float(total.most[reward]),
        longest_episode=episodes.longest,
        dense_reward_range=dense,
    )


def _is_step(episodes: Episodes, first: int, last: int) -> npt.NDArray[np.bool_]:
    """Whether rows first to last - 1 are transitions, (last - first,); the others are last observations."""
    rows = np.arange(first, last)
    latest = np.searchsorted(episodes.starts, rows, side="right") - 1
    ends = episodes.starts[latest] + episodes.lengths[latest]
    result: npt.NDArray[np.bool_] = (latest >= 0) & (rows < ends)
    return result


class _Sums:
    """Mean, variance and range of columns, merged chunk by chunk (Chan, Golub and LeVeque, 1983)."""

    def __init__(self, columns: int) -> None:
        self.count, self.mean, self._squares = 0, np.zeros(columns), np.zeros(columns)
        self.least, self.most = np.full(columns, np.inf), np.full(columns, -np.inf)

    def add(self, values: Values) -> None:
        if not len(values):
            return
        count, mean = self.count + len(values), values.mean(axis=0)
        difference = mean - self.mean
        between = difference**2 * self.count * len(values) / count
        self._squares += np.square(values - mean).sum(axis=0) + between
        self.mean = self.mean + difference * len(values) / count
        self.least, self.most = (
            np.minimum(self.least, values.min(axis=0)),
            np.maximum(self.most, values.max(axis=0)),
        )
        self.count = count

    @property
    def std(self) -> Values:
        result: Values = np.maximum(np.sqrt(self._squares / self.count), SMALLEST_STD)
        return result
