"""What a report counts while it reads a dataset part by part; no measure keeps a part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.report.plane import Plane
from tcmrl_data.store.keys import PartKey

BINS = 32
"""Cells of the map of visits along each axis."""

ACTION_BINS = 40
SATURATED = 0.99
"""An action of at least this size counts as saturated; actions lie in [-1, 1]."""

RETURN_BINS = 40

Arrays = Mapping[str, npt.NDArray[Any]]
Counts = npt.NDArray[np.int64]


class Measure(Protocol):
    """Something that is counted over parts."""

    def add(self, key: PartKey, arrays: Arrays) -> None:
        """Counts a part in.

        Args:
            key: of the part.
            arrays: its arrays; steps of all episodes lie behind one another.
        """


@final
class Visits:
    """How often the states of a task were visited, as cells of the plane.

    Attributes:
        counts: by task: (BINS, BINS), rows along the second coordinate.
        outside: number of states beyond the plane's borders.
        total: number of states.
    """

    def __init__(self, plane: Plane, tasks: Sequence[int]) -> None:
        self._plane = plane
        self.counts: dict[int, Counts] = {task: np.zeros((BINS, BINS), np.int64) for task in tasks}
        self.outside = self.total = 0

    def add(self, key: PartKey, arrays: Arrays) -> None:
        if key.task not in self.counts:
            return
        points = self._plane.project(arrays["observations"])
        with np.errstate(invalid="ignore"):
            cells = np.floor((points - self._plane.low) / (self._plane.high - self._plane.low) * BINS)
        inside = np.isfinite(cells).all(axis=1) & ((cells >= 0) & (cells < BINS)).all(axis=1)
        x, y = cells[inside].astype(np.int64).T
        self.counts[key.task] += np.bincount(y * BINS + x, minlength=BINS * BINS).reshape(BINS, BINS)
        self.outside += int((~inside).sum())
        self.total += len(points)


@final
class Actions:
    """How often actions were taken, by snapshot step.

    Attributes:
        counts: by step: (action columns, ACTION_BINS) over [-1, 1]; what lies beyond counts at the ends.
        saturated: by step: number of values of at least SATURATED in size.
        values: by step: number of values.
    """

    def __init__(self) -> None:
        self.counts: dict[int, Counts] = {}
        self.saturated: dict[int, int] = {}
        self.values: dict[int, int] = {}

    def add(self, key: PartKey, arrays: Arrays) -> None:
        actions, step = arrays["actions"], key.step
        columns = actions.shape[1]
        bins = np.clip((np.nan_to_num(actions) + 1.0) * (ACTION_BINS / 2), 0, ACTION_BINS - 1).astype(
            np.int64
        )
        flat = (bins + np.arange(columns) * ACTION_BINS).ravel()
        counts = np.bincount(flat, minlength=columns * ACTION_BINS).reshape(columns, ACTION_BINS)
        self.counts[step] = self.counts.get(step, 0) + counts
        self.saturated[step] = self.saturated.get(step, 0) + int((np.abs(actions) >= SATURATED).sum())
        self.values[step] = self.values.get(step, 0) + actions.size

    def saturated_share(self, step: int) -> float:
        """Share of the values of a step that are saturated."""
        return self.saturated[step] / max(1, self.values[step])


@dataclass
class EndingCounts:
    """Episodes of one snapshot step.

    Attributes:
        episodes: number of episodes.
        terminated: episodes that the task ended.
        truncated: episodes that the time limit ended.
        shortest: steps of the shortest episode.
        longest: steps of the longest one.
        steps: of all episodes.
        returns: number of episodes by return, in the bins of `Episodes.edges`.
    """

    episodes: int = 0
    terminated: int = 0
    truncated: int = 0
    shortest: int = 0
    longest: int = 0
    steps: int = 0
    returns: Counts = field(default_factory=lambda: np.zeros(RETURN_BINS, np.int64))


@final
class Episodes:
    """Lengths, endings and returns of episodes, by snapshot step.

    Args:
        low: smallest return of an episode in the dataset.
        high: largest one.

    Attributes:
        edges: (RETURN_BINS + 1,) borders of the bins of returns.
        found: counts by step.
    """

    def __init__(self, low: float, high: float) -> None:
        self.edges: FloatArray = np.linspace(low, high if high > low else low + 1.0, RETURN_BINS + 1)
        self.found: dict[int, EndingCounts] = {}

    def add(self, key: PartKey, arrays: Arrays) -> None:
        offsets = arrays["episode_offsets"]
        lengths = np.diff(offsets)
        found = self.found.setdefault(key.step, EndingCounts(shortest=int(lengths.min())))
        found.episodes += len(lengths)
        found.steps += int(lengths.sum())
        found.shortest = min(found.shortest, int(lengths.min()))
        found.longest = max(found.longest, int(lengths.max()))
        found.terminated += int((per_episode(arrays["terminated"], offsets) > 0).sum())
        found.truncated += int((per_episode(arrays["truncated"], offsets) > 0).sum())
        returns = np.clip(per_episode(arrays["rewards"], offsets), self.edges[0], self.edges[-1])
        found.returns += np.histogram(returns, self.edges)[0]


def per_episode(values: npt.NDArray[Any], offsets: npt.NDArray[np.int64]) -> FloatArray:
    """Sums (episodes,) of a value per step, in double precision; an episode without steps has 0."""
    sums = np.concatenate([[0.0], np.cumsum(values.astype(np.float64))])
    totals: FloatArray = sums[offsets[1:]] - sums[offsets[:-1]]
    return totals
