"""The content of a batch, as kinds of data by name, and the draws of its rows, which reads no row."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.base import Reward
from tcmrl_data.foundation.errors import RequestError
from tcmrl_data.sampling.rows import Episodes, Indices


@dataclass(frozen=True)
class Transitions:
    """Single transitions, drawn uniformly from all transitions of a task, with replacement.

    Attributes:
        returns: whether steps include returns to go, discounts, final observations and times.
        rewards: `dense` takes the array `dense_rewards` as the steps' rewards, which environments with sparse
            rewards may store beside them. The same transitions are drawn.
    """

    length: ClassVar[int] = 1
    number: int
    returns: bool = False
    rewards: Reward = "stored"


@dataclass(frozen=True, init=False)
class Trajectories:
    """Whole episodes, drawn uniformly from all episodes of a task, without replacement.

    Attributes:
        numbers: episodes per task; of several numbers, one is drawn for every batch.
        apart_from: name of another kind of trajectories; a batch has no episode in both kinds.
        returns: as for `Transitions`.
    """

    rewards: ClassVar[Reward] = "stored"
    numbers: tuple[int, ...]
    apart_from: str | None = None
    returns: bool = False

    def __init__(
        self, numbers: int | tuple[int, ...], *, apart_from: str | None = None, returns: bool = False
    ) -> None:
        object.__setattr__(self, "numbers", (numbers,) if isinstance(numbers, int) else tuple(numbers))
        object.__setattr__(self, "apart_from", apart_from)
        object.__setattr__(self, "returns", returns)

    @property
    def number(self) -> int:
        """The largest number of episodes per task."""
        return max(self.numbers, default=0)


@dataclass(frozen=True)
class Windows:
    """Consecutive transitions of one episode, drawn uniformly from all windows of a task, with replacement.

    Attributes:
        length: transitions per window.
        returns: as for `Transitions`.
    """

    rewards: ClassVar[Reward] = "stored"
    number: int
    length: int
    returns: bool = False


Kind: TypeAlias = Transitions | Trajectories | Windows


@dataclass(frozen=True)
class BatchRequest:
    """The content of a sampler's batches.

    Attributes:
        tasks: tasks per batch, drawn without replacement; a batch holds all selected tasks if they are fewer.
        kinds: kinds of data to draw for every task, by names that the method chooses. A kind with number 0
            is omitted. A kind's draws depend on its name and not on other kinds.
        gamma: discount factor of the returns to go.

    Raises:
        RequestError: a number is negative or missing, a window's length is below 1, gamma lies outside
            [0, 1], or `apart_from` does not name another kind of trajectories, or joins more than two kinds.

    Example:
        >>> request = BatchRequest(
        ...     tasks=4,
        ...     kinds={
        ...         "policy": Transitions(256),
        ...         "context": Trajectories((1, 2)),
        ...         "execution": Trajectories(1, apart_from="context"),
        ...         "windows": Windows(0, length=8),
        ...     },
        ... )
        >>> list(request.kinds)
        ['policy', 'context', 'execution']
    """

    tasks: int
    kinds: Mapping[str, Kind]
    gamma: float = 1.0

    def __post_init__(self) -> None:
        if self.tasks < 1:
            raise RequestError(f"a batch holds at least 1 task, the request says {self.tasks}")
        if not 0 <= self.gamma <= 1:
            raise RequestError(f"gamma must lie in [0, 1], the request says {self.gamma}")
        for name, kind in self.kinds.items():
            _check_numbers(name, kind)
        _check_partners(self.kinds)
        kinds = {name: kind for name, kind in self.kinds.items() if kind.number}
        object.__setattr__(self, "kinds", kinds)

    @property
    def takes_dense(self) -> bool:
        """Whether a kind takes dense rewards."""
        return any(kind.rewards == "dense" for kind in self.kinds.values())


def _check_numbers(name: str, kind: Kind) -> None:
    numbers = kind.numbers if isinstance(kind, Trajectories) else (kind.number,)
    if not numbers or min(numbers) < 0:
        raise RequestError(
            f"{name!r}: numbers must be 0 or more and at least one, the request says {numbers}"
        )
    if isinstance(kind, Windows) and kind.length < 1:
        raise RequestError(f"{name!r}: a window has at least 1 step, the request says {kind.length}")


def _check_partners(kinds: Mapping[str, Kind]) -> None:
    """Checks that `apart_from` joins two kinds; they read one order from its two ends."""
    pairs = {
        name: kind.apart_from
        for name, kind in kinds.items()
        if isinstance(kind, Trajectories) and kind.apart_from is not None
    }
    for name, partner in pairs.items():
        if partner == name or not isinstance(kinds.get(partner), Trajectories):
            raise RequestError(f"{name!r}: apart_from={partner!r} names no other kind of trajectories")
        if partner in pairs or list(pairs.values()).count(partner) > 1:
            raise RequestError(
                f"{name!r}: apart_from={partner!r} would join more than two kinds; leave one of them free"
            )


Key = npt.NDArray[np.unsignedinteger[Any]]
Uniform = npt.NDArray[np.float64]

BLOCK = 16
"""Number of batches whose indices are drawn together, from one value of the generators' counter."""


class Draw(NamedTuple):
    """The indices of one batch.

    Attributes:
        tasks: (tasks,) positions of the tasks.
        picks: (tasks, number) indices by name of the kind: rows of transitions, first rows of windows, or
            episodes of trajectories.
    """

    tasks: Indices
    picks: dict[str, Indices]


@dataclass(frozen=True)
class Starts:
    """The rows at which a window of K steps within an episode can start, numbered from 0 in ascending order.

    Attributes:
        before: (episodes,) number of starts in earlier episodes.
        first_rows: (episodes,) first row of every episode.
        task_ranges: (tasks, 2) first number and last number + 1 of every task's starts.
        per_episode: number of starts per episode, if all episodes have equally many; else 0.
    """

    before: Indices
    first_rows: Indices
    task_ranges: Indices
    per_episode: int

    @classmethod
    def of(cls, episodes: Episodes, steps: int) -> "Starts":
        """The starts of windows of `steps` steps; `steps` is 1 for transitions."""
        counts = np.maximum(episodes.lengths - steps + 1, 0)
        ends = np.concatenate([[0], np.cumsum(counts)])
        same = int(counts[0]) if len(counts) and (counts == counts[0]).all() else 0
        return cls(ends[:-1], episodes.starts, ends[episodes.task_ranges], same)

    def draw(self, tasks: Indices, uniform: Uniform) -> Indices:
        """Draws rows (..., tasks, count), uniform over the starts of the row's task.

        Args:
            tasks: (..., tasks) positions of tasks.
            uniform: (..., tasks, count) uniform random numbers in [0, 1).
        """
        first, last = self.task_ranges[tasks][..., None, 0], self.task_ranges[tasks][..., None, 1]
        if self.per_episode:  # the integer part selects an episode, the fraction a start within it
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
    """Draws batches from the tasks' episodes; batch n is a pure function of (sequence, n).

    The choice of tasks and every kind have their own counter-based generator (Philox; Salmon et al., 2011).
    The key of a kind's generator depends on the kind's name.

    Args:
        request: the content of a batch; a batch holds all tasks if there are fewer than requested.
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
        """Number of transitions or windows of every task that may be drawn, (tasks,)."""
        result: Indices = np.diff(self._starts[name][2].task_ranges)[:, 0]
        return result

    def __call__(self, n: int) -> Draw:
        """The indices of batch n."""
        number, block = self._block
        if number != n // BLOCK:
            number, block = n // BLOCK, self._make(n // BLOCK)
            self._block = (number, block)  # one assignment, because threads may draw at the same time
        return block[n % BLOCK]

    def _make(self, number: int) -> list[Draw]:
        """Draws batches number * BLOCK, …, (number + 1) * BLOCK - 1, from 53-bit uniform random numbers."""
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
    """The kind whose order of episodes a kind reads, and the number of places that it needs."""
    return kind.apart_from or name, places_filled(kind.number, from_back=kind.apart_from is not None)


def _key(sequence: np.random.SeedSequence, *names: str) -> Key:
    """The key of the generator for a purpose, given the seed sequence of the stream."""
    entries = [int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big") for name in names]
    own = np.random.SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, *entries))
    return own.generate_state(2, np.uint64)


def _generator(key: Key, block: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, block]))


def places_filled(number: int, *, from_back: bool) -> int:
    """The number of places to fill in order to read `number` episodes from one end."""
    return max(0, 2 * number - 1 + from_back)


def fill_places(counts: Indices, uniform: Uniform) -> Indices:
    """Fills the outer places of random orders (permutations) of tasks' episodes.

    Places are filled from the outside in: first, last, second, second to last, and so on. The episode at a
    place is uniform over the episodes not yet placed, so all orders are equally likely, and it depends only
    on the random numbers of this place and of the places filled before. Two kinds that read one order from
    its two ends share no episode, and the number of one kind does not change the draws of the other.

    Args:
        counts: (...) number of episodes of every order.
        uniform: (places, ...) uniform random numbers in [0, 1).

    Returns:
        (places, ...) episodes in the sequence in which places are filled; entry k is not defined if k is
        not below an order's count.
    """
    places = len(uniform)
    found = np.empty(uniform.shape, dtype=np.int64)
    taken = np.full((places + 1, *counts.shape), np.iinfo(np.int64).max)  # ascending
    before = np.arange(places).reshape(places, *[1] * counts.ndim)
    for k in range(places):
        pick = below(uniform[k], np.maximum(counts - k, 1))
        if k:  # skip every taken episode that has at most `pick` free episodes before it
            pick += (taken[:k] - before[:k] <= pick).sum(axis=0)
        found[k] = pick
        taken[1 : k + 1] = np.minimum(np.maximum(taken[:k], pick), taken[1 : k + 1])
        taken[0] = np.minimum(taken[0], pick)
    return found


def read_end(filled: Indices, counts: Indices, number: int, *, from_back: bool) -> Indices:
    """Reads episodes (..., number) from one end of every order, the outermost episode first.

    Args:
        filled: the result of `fill_places`, with at least `places_filled(number)` places or with all places.
        counts: (...) number of episodes of every order, at least `number`.
        from_back: reads from the back if True, from the front otherwise.
    """
    inwards = np.arange(number).reshape(number, *[1] * counts.ndim)
    place = 2 * inwards + from_back
    from_other_end = 2 * (counts - 1 - inwards) + (not from_back)
    index = np.where(place < counts, place, from_other_end)
    return np.ascontiguousarray(np.moveaxis(np.take_along_axis(filled, index, axis=0), 0, -1))


def below(uniform: Uniform, counts: Indices | int) -> Indices:
    """Random integers in [0, counts); a float below 1 times a count never rounds up to the count."""
    result: Indices = (uniform * counts).astype(np.int64)
    return result
