"""Which rows make batch n: index arithmetic alone, for several batches at a time."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tcmrl_data.sampling.request import BatchRequest, Trajectories, Windows
from tcmrl_data.sampling.rows import Episodes, Indices

Uniform = npt.NDArray[np.float64]

BLOCK = 16
"""Batches whose indices are computed together; they come from one run of the counter."""


class Draw(NamedTuple):
    """The rows of one batch.

    Attributes:
        tasks: (tasks,) positions of the tasks.
        picks: (tasks, number) by kind: rows of transitions, first rows of windows, episodes.
    """

    tasks: Indices
    picks: dict[str, Indices]


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
        request: what a batch takes; at most as many tasks as there are.
        key: (2,) uint64 of the counter-based generator (Philox; Salmon et al., 2011).
    """

    def __init__(
        self, episodes: Episodes, request: BatchRequest, *, key: npt.NDArray[np.unsignedinteger[Any]]
    ) -> None:
        self._key, self._episode_ranges = key, episodes.task_ranges
        kinds = request.kinds.items()
        self._trajectories = {name: kind for name, kind in kinds if isinstance(kind, Trajectories)}
        stretches = [(name, kind) for name, kind in kinds if not isinstance(kind, Trajectories)]
        stretches.sort(key=lambda item: isinstance(item[1], Windows))
        self._starts = {name: (kind.number, Starts.of(episodes, kind.length)) for name, kind in stretches}
        self.num_tasks = min(request.tasks, len(episodes.task_ranges))
        self._block: tuple[int, list[Draw]] = (-1, [])

    def num_starts(self, name: str) -> Indices:
        """(tasks,) valid transitions or windows of each task."""
        result: Indices = np.diff(self._starts[name][1].task_ranges)[:, 0]
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
        random = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, 0, number]))
        order = random.random((BLOCK, len(self._episode_ranges))).argsort(axis=1)
        tasks: Indices = order[:, : self.num_tasks].astype(np.int64)
        chosen = random.random(BLOCK)
        shape = (BLOCK, self.num_tasks)
        picks = {
            name: list(starts.draw(tasks, random.random((*shape, count))))
            for name, (count, starts) in self._starts.items()
        }
        most = sum(kind.number for kind in self._trajectories.values())
        episodes = distinct(self._episode_ranges[tasks], random.random((*shape, most)))
        first = np.zeros(BLOCK, dtype=np.int64)
        for name, kind in self._trajectories.items():
            last = first + np.array(kind.numbers)[_below(chosen, len(kind.numbers))]
            picks[name] = [episodes[i, :, first[i] : last[i]] for i in range(BLOCK)]
            first = last
        return [Draw(tasks[i], {name: found[i] for name, found in picks.items()}) for i in range(BLOCK)]


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
