"""Episodes that a report keeps to draw them: paths through the plane, and whole episodes to browse."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.report.measures import Arrays
from tcmrl_data.report.plane import Plane
from tcmrl_data.store.keys import PartKey

PATHS = 3
"""Episodes of a part whose paths are drawn."""

PATH_POINTS = 40
"""Points of a path; longer ones are thinned out."""

BROWSED_STEPS = 400
"""Steps of a browsed episode that are drawn."""

BROWSED_COLUMNS = 8
"""Columns of observations and of actions that are drawn of a browsed episode."""


@final
class Paths:
    """The first episodes of chosen parts, as paths through the plane.

    Attributes:
        found: by part: (points, 2), float32, with a row of NaN behind every episode.
    """

    def __init__(self, plane: Plane, keys: Sequence[PartKey]) -> None:
        self._plane, self._keys = plane, frozenset(keys)
        self.found: dict[PartKey, FloatArray] = {}

    def add(self, key: PartKey, arrays: Arrays) -> None:
        if key not in self._keys:
            return
        pieces = []
        for episode in range(min(PATHS, len(arrays["episode_offsets"]) - 1)):
            start, stop = arrays["episode_offsets"][episode : episode + 2]
            points = self._plane.project(arrays["observations"][start + episode : stop + episode + 1])
            pieces += [points[_thinned(len(points), PATH_POINTS)], np.full((1, 2), np.nan)]
        self.found[key] = np.concatenate(pieces).astype(np.float32)


@dataclass(frozen=True)
class Browsed:
    """An episode to browse.

    Attributes:
        key: of its part.
        episode: its place in the part.
        length: number of steps.
        total: its undiscounted return.
        ended: how it ended: terminated, truncated, or cut where neither is stored.
        steps: (rows,) of the drawn steps.
        rewards: (rows,).
        observations: (rows, drawn columns).
        actions: (rows, drawn columns).
        columns: number of observation columns and of action columns, drawn or not.
    """

    key: PartKey
    episode: int
    length: int
    total: float
    ended: str
    steps: FloatArray
    rewards: FloatArray
    observations: FloatArray
    actions: FloatArray
    columns: tuple[int, int]


def browse(dataset: Dataset, keys: Sequence[PartKey], count: int) -> list[Browsed]:
    """Episodes of different parts, evenly spread over a dataset's; one part is in memory at a time.

    Args:
        dataset: the dataset.
        keys: of its parts.
        count: number of episodes; fewer where there are fewer parts.
    """
    places = np.unique(np.linspace(0, len(keys) - 1, count).round().astype(int))
    return [_browsed(dataset, keys[place], number) for number, place in enumerate(places)]


def _browsed(dataset: Dataset, key: PartKey, number: int) -> Browsed:
    trajectories = dataset.trajectories(*key)
    episode = number % len(trajectories)
    trajectory = trajectories[episode]
    rows = _thinned(len(trajectory), BROWSED_STEPS)
    ended = (
        "terminated" if trajectory.terminated.any() else "truncated" if trajectory.truncated.any() else "cut"
    )
    return Browsed(
        key,
        episode,
        len(trajectory),
        trajectory.undiscounted_return,
        ended,
        rows.astype(np.float32),
        trajectory.rewards[rows].astype(np.float32),
        trajectory.observations[rows, :BROWSED_COLUMNS].astype(np.float32),
        trajectory.actions[rows, :BROWSED_COLUMNS].astype(np.float32),
        (trajectory.observations.shape[1], trajectory.actions.shape[1]),
    )


def _thinned(length: int, count: int) -> FloatArray:
    """Places 0 to `length` - 1, or `count` of them with the first and the last."""
    return np.unique(np.linspace(0, max(length - 1, 0), count).round().astype(int))[:length]
