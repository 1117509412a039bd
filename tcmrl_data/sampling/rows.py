"""Packed rows: all selected steps in one float32 table."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.store.arrays import Arrays, array_digests, checked_offsets, read_arrays
from tcmrl_data.store.manifest import ArrayRecord

if TYPE_CHECKING:
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

    An episode of T steps has T + 1 rows, so that the next observation is in the next row; the last row of an
    episode holds an observation and zeros. After the last episode follow at least as many rows of zeros as
    the longest episode has steps, so that a block of that length can start at any episode.

    Attributes:
        table: (rows, observation_dim + action_dim + 2).
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


@dataclass(frozen=True)
class PartRows:
    """The rows of one part.

    Attributes:
        folder: the part's folder.
        task: position of the part's task in the selection.
        first: its first row.
        last: its last row + 1.
        records: the part's record of every array.
    """

    folder: Path
    task: int
    first: int
    last: int
    records: Mapping[str, ArrayRecord]


def plan_rows(selection: "Selection") -> list[PartRows]:
    """Plans the rows of a selection's parts; reads the parts' records only.

    Raises:
        StoreError: the observations or actions of a part do not have the environment's width.
    """
    dataset, plan, first = selection.dataset, [], 0
    widths = {
        "observations": dataset.environment.observation_dim,
        "actions": dataset.environment.action_dim,
    }
    for position, task in enumerate(selection.tasks):
        for step in selection.steps[task.index]:
            folder, arrays = (
                dataset.folder_of(task.index, step),
                dataset.part(task.index, step).identity.arrays,
            )
            for name, width in widths.items():
                if arrays[name].shape[1] != width:
                    raise StoreError(
                        f"{folder}: {name} are {arrays[name].shape[1]} wide, {dataset.name} has {width}; "
                        "run `tcmrl-data repair`"
                    )
            last = first + arrays["observations"].shape[0]
            plan.append(PartRows(folder, position, first, last, arrays))
            first = last
    return plan


def table_shape(selection: "Selection", plan: Sequence[PartRows]) -> tuple[int, int]:
    """Shape of a selection's table; its padding is as long as the largest part, hence as any episode."""
    environment = selection.dataset.environment
    padding = max(part.last - part.first for part in plan)
    return plan[-1].last + padding, environment.observation_dim + environment.action_dim + 2


def read_rows(selection: "Selection") -> PackedRows:
    """Reads a selection into memory.

    Raises:
        StoreError: arrays cannot be decoded or do not form episodes; the message names the part.
    """
    plan = plan_rows(selection)
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
        StoreError: arrays cannot be decoded, do not form episodes, or are not those of the part's record;
            the message names the part.
    """
    arrays = read_arrays(part.folder, ROW_ARRAYS)
    if check_digests:
        _check_digests(part, arrays)
    try:
        return fill_rows(out, arrays)
    except StoreError as error:
        raise StoreError(f"{part.folder}: {error}; run `tcmrl-data repair`") from None


def _check_digests(part: PartRows, arrays: Arrays) -> None:
    for name, found in array_digests(arrays).items():
        record = part.records[name]
        if found != {"dtype": record.dtype, "shape": list(record.shape), "sha256": record.sha256}:
            raise StoreError(
                f"{part.folder}: {name} is not the array that part.json records; run `tcmrl-data repair`"
            )


def fill_rows(out: Table, arrays: Arrays) -> Indices:
    """Writes a part's arrays into rows of zeros; returns the lengths of its episodes.

    Args:
        out: (observations, width), the part's rows.
        arrays: the part's arrays.

    Raises:
        StoreError: the arrays do not form episodes, or do not have as many observations as `out` has rows.
    """
    observations, actions = arrays["observations"], arrays["actions"]
    offsets = checked_offsets(arrays["episode_offsets"], len(actions))
    lengths = np.diff(offsets)
    if len(observations) != len(actions) + len(lengths) or len(observations) != len(out):
        raise StoreError(
            f"{len(observations)} observations do not fit {len(actions)} actions in {len(lengths)} episodes"
        )
    for name in ("rewards", "terminated"):
        if len(arrays[name]) != len(actions):
            raise StoreError(f"{name} has {len(arrays[name])} steps, actions have {len(actions)}")
    observation_dim = observations.shape[1]
    # an episode has one row more than steps
    steps = np.arange(len(actions)) + np.repeat(np.arange(len(lengths)), lengths)
    out[:, :observation_dim] = observations
    out[steps, observation_dim:-2] = actions
    out[steps, -2] = arrays["rewards"]
    out[steps, -1] = arrays["terminated"]
    return lengths
