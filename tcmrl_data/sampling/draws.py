"""Which rows make batch n: index arithmetic alone, for several batches at a time."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tcmrl_data.sampling.batch import BatchSizes
from tcmrl_data.sampling.rows import Episodes, Indices

Uniform = npt.NDArray[np.float64]

BLOCK = 16
"""Batches whose indices are computed together; they come from one run of the counter."""


class Draw(NamedTuple):
    """The rows of one batch.

    Attributes:
        tasks: (tasks,) positions of the tasks.
        transitions: (tasks, transitions) rows.
        windows: (tasks, windows) first rows.
        trajectories: (tasks, context + execution) episodes, the context ones first.
        num_context: how many are context.
    """

    tasks: Indices
    transitions: Indices
    windows: Indices
    trajectories: Indices
    num_context: int


@dataclass(frozen=True)
class Starts:
    """The rows from which K steps stay inside an episode, numbered from 0 in their order.

    Attributes:
        before: (episodes,) how many of them lie in earlier episodes.
        first_rows: (episodes,) first row of each episode.
        task_ranges: (tasks, 2) first and last + 1 of each task's numbers.
        per_episode: how many each episode has, where all have equally many; 0 elsewhere.
    """

    before: Indices
    first_rows: Indices
    task_ranges: Indices
    per_episode: int

    @classmethod
    def of(cls, episodes: Episodes, steps: int) -> "Starts":
        """Those for windows of `steps` steps; 1 for transitions."""
        counts = np.maximum(episodes.lengths - steps + 1, 0)
        ends = np.concatenate([[0], np.cumsum(counts)])
        same = int(counts[0]) if len(counts) and (counts == counts[0]).all() else 0
        return cls(ends[:-1], episodes.starts, ends[episodes.task_ranges], same)

    def draw(self, tasks: Indices, uniform: Uniform) -> Indices:
        """Rows uniform over each task's, one per number in [0, 1), (..., tasks, count).

        Args:
            tasks: (..., tasks) positions.
            uniform: the numbers.
        """
        first, last = self.task_ranges[tasks][..., None, 0], self.task_ranges[tasks][..., None, 1]
        if self.per_episode:  # an episode, and of what is left of the number a place in it
            places = uniform * ((last - first) / self.per_episode)
            drawn = places.astype(np.int64)
            places -= drawn
            places *= self.per_episode
            drawn += first // self.per_episode
            result: Indices = self.first_rows[drawn]
            result += places.astype(np.int64)
            return result
        numbers = first + _below(uniform, last - first)
        episodes = np.searchsorted(self.before, numbers, side="right") - 1
        result = self.first_rows[episodes] + (numbers - self.before[episodes])
        return result


class Draws:
    """Draws batches from the episodes of the tasks; batch n is a pure function of (key, n).

    Args:
        episodes: what there is.
        sizes: what a batch takes; at most as many tasks as there are.
        key: (2,) uint64 of the counter-based generator (Philox; Salmon et al., 2011).
    """

    def __init__(
        self, episodes: Episodes, sizes: BatchSizes, *, key: npt.NDArray[np.unsignedinteger[Any]]
    ) -> None:
        self._sizes, self._key, self._episode_ranges = sizes, key, episodes.task_ranges
        self._transitions = Starts.of(episodes, 1)
        self._windows = Starts.of(episodes, sizes.window_length)
        self.num_tasks = min(sizes.tasks, len(episodes.task_ranges))
        self._block: tuple[int, list[Draw]] = (-1, [])

    @property
    def num_windows(self) -> Indices:
        """(tasks,) valid windows of each task."""
        result: Indices = np.diff(self._windows.task_ranges)[:, 0]
        return result

    def __call__(self, n: int) -> Draw:
        """The rows of batch n."""
        number, block = self._block
        if number != n // BLOCK:
            number, block = n // BLOCK, self._make(n // BLOCK)
            self._block = (number, block)  # both at once: another thread may ask for another batch
        return block[n % BLOCK]

    def _make(self, number: int) -> list[Draw]:
        """The batches number * BLOCK, …, from uniform numbers in [0, 1) of 53 bits."""
        sizes, all_tasks = self._sizes, len(self._episode_ranges)
        random = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, 0, number]))
        order = random.random((BLOCK, all_tasks)).argsort(axis=1)
        tasks: Indices = order[:, : self.num_tasks].astype(np.int64)
        choices = np.array(sizes.context_trajectories)
        context = choices[_below(random.random(BLOCK), len(choices))]
        shape = (BLOCK, self.num_tasks)
        transitions = self._transitions.draw(tasks, random.random((*shape, sizes.transitions)))
        windows = self._windows.draw(tasks, random.random((*shape, sizes.windows)))
        most = int(choices.max()) + sizes.execution_trajectories
        trajectories = distinct(self._episode_ranges[tasks], random.random((*shape, most)))
        return [
            Draw(
                tasks[i],
                transitions[i],
                windows[i],
                trajectories[i, :, : count + sizes.execution_trajectories],
                count,
            )
            for i, count in enumerate(context.tolist())
        ]


def distinct(ranges: Indices, uniform: Uniform) -> Indices:
    """(..., count) integers, uniform without replacement within each [first, last).

    Args:
        ranges: (..., 2).
        uniform: (..., count) in [0, 1); the k-th picks among what the first k - 1 left.
    """
    count = uniform.shape[-1]
    picks = np.zeros(uniform.shape, dtype=np.int64)
    for j in range(count):
        pick = _below(uniform[..., j], ranges[..., 1] - ranges[..., 0] - j)
        for k in range(j):  # step over what is taken, smallest first
            pick += pick >= np.sort(picks[..., :j], axis=-1)[..., k]
        picks[..., j] = pick
    result: Indices = picks + ranges[..., :1]
    return result


def _below(uniform: Uniform, counts: Indices | int) -> Indices:
    """Integers below the counts; the product of a float below 1 and a count never rounds up to the count."""
    result: Indices = (uniform * counts).astype(np.int64)
    return result
