"""Which rows make batch n: index arithmetic alone, for several batches at a time."""

import hashlib
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tcmrl_data.sampling.orders import Uniform, below, fill_places, places_filled, read_end
from tcmrl_data.sampling.request import BatchRequest, Trajectories
from tcmrl_data.sampling.rows import Episodes, Indices

Key = npt.NDArray[np.unsignedinteger[Any]]

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
        numbers = first + below(uniform, last - first)
        episodes = np.searchsorted(self.before, numbers, side="right") - 1
        result = self.first_rows[episodes] + (numbers - self.before[episodes])
        return result


class Draws:
    """Draws batches from the episodes of the tasks; batch n is a pure function of (sequence, n).

    Tasks and every kind draw from counter-based generators of their own (Philox; Salmon et al., 2011), a
    kind's keyed by its name.

    Args:
        episodes: what there is.
        request: what a batch takes; at most as many tasks as there are.
        sequence: addresses the stream of batches.
    """

    def __init__(
        self, episodes: Episodes, request: BatchRequest, *, sequence: np.random.SeedSequence
    ) -> None:
        self._ranges, self._task_key = episodes.task_ranges, _key(sequence)
        self._starts: dict[str, tuple[Key, int, Starts]] = {}
        self._ends: dict[str, tuple[Key, Trajectories]] = {}
        self._orders: dict[str, tuple[Key, int]] = {}
        most_episodes = int(np.diff(episodes.task_ranges).max())
        for name, kind in request.kinds.items():
            key = _key(sequence, name, "numbers")
            if isinstance(kind, Trajectories):
                self._ends[name] = (key, kind)
                order, needed = _order_of(name, kind)
                _, places = self._orders.get(order, (key, 0))
                places = min(max(places, needed), most_episodes)
                self._orders[order] = (_key(sequence, order, "order"), places)
            else:
                self._starts[name] = (key, kind.number, Starts.of(episodes, kind.length))
        self.num_tasks = min(request.tasks, len(episodes.task_ranges))
        self._block: tuple[int, list[Draw]] = (-1, [])

    def num_starts(self, name: str) -> Indices:
        """(tasks,) valid transitions or windows of each task."""
        result: Indices = np.diff(self._starts[name][2].task_ranges)[:, 0]
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
        uniform = _generator(self._task_key, number).random((BLOCK, len(self._ranges)))
        tasks: Indices = uniform.argsort(axis=1)[:, : self.num_tasks].astype(np.int64)
        picks: dict[str, list[Indices]] = {}
        for name, (key, count, starts) in self._starts.items():
            random = _generator(key, number)
            picks[name] = list(starts.draw(tasks, random.random((*tasks.shape, count))))
        first, last = np.moveaxis(self._ranges[tasks], -1, 0)
        counts = last - first
        orders = {
            name: fill_places(counts, _generator(key, number).random((places, *tasks.shape)))
            for name, (key, places) in self._orders.items()
        }
        for name, (key, kind) in self._ends.items():
            filled = orders[_order_of(name, kind)[0]]
            episodes = read_end(filled, counts, kind.number, from_back=kind.apart_from is not None)
            episodes += first[..., None]
            chosen = below(_generator(key, number).random(BLOCK), len(kind.numbers))
            picks[name] = [episodes[i, :, : kind.numbers[chosen[i]]] for i in range(BLOCK)]
        return [Draw(tasks[i], {name: found[i] for name, found in picks.items()}) for i in range(BLOCK)]


def _order_of(name: str, kind: Trajectories) -> tuple[str, int]:
    """The kind whose order of episodes a kind reads, and how many of its places must be filled."""
    return kind.apart_from or name, places_filled(kind.number, from_back=kind.apart_from is not None)


def _key(sequence: np.random.SeedSequence, *names: str) -> Key:
    """The generator's key of a purpose under the stream of batches."""
    entries = [int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big") for name in names]
    own = np.random.SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, *entries))
    return own.generate_state(2, np.uint64)


def _generator(key: Key, block: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, block]))
