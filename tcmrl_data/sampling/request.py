"""Batch requests: the content of a batch, as kinds of data by name."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from tcmrl_data.envs.base import Reward
from tcmrl_data.foundation.errors import RequestError


@dataclass(frozen=True)
class Transitions:
    """Single transitions, drawn uniformly from all transitions of a task, with replacement.

    Attributes:
        number: transitions per task.
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
        number: windows per task.
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
