"""Everything that a report shows, measured of a dataset with one part in memory at a time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import dataset_summary, list_returns, list_tasks
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import FloatArray, Trajectory
from tcmrl_data.foundation.errors import SelectionError, TcmrlError
from tcmrl_data.foundation.seeding import evenly_spread
from tcmrl_data.quality.coverage import Coverage, measure_coverage
from tcmrl_data.quality.rewards import Rewards, measure_rewards
from tcmrl_data.quality.scores import Quality, measure_quality
from tcmrl_data.quality.transfer import Transfer, measure_transfer
from tcmrl_data.store.tables import PartKey

SHOWN_TASKS = 100
"""Tasks with a map of visits, paths and a learning curve; of more tasks, evenly chosen ones."""

SAMPLED_PARTS, SAMPLED_STATES = 64, 2_000
"""Parts, and states of each, that the plane and its borders are computed from, evenly spread."""

BORDER = 0.05
"""What the plane shows around the sampled states, as a share of their range."""

BINS = 32
"""Cells of the map of visits along each axis."""

ACTION_BINS = 40
SATURATED = 0.99
"""An action of at least this size counts as saturated; actions lie in [-1, 1]."""

RETURN_BINS = 40

PATHS, PATH_POINTS = 3, 40
"""Episodes of a part whose paths are drawn, and points of a path; longer ones are thinned out."""

BROWSED_STEPS, BROWSED_COLUMNS = 400, 8
"""Steps of a browsed episode, and columns of its observations and of its actions, that are drawn."""

_Counts = npt.NDArray[np.int64]
_Episodes = Sequence[Trajectory]
StageProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Content:
    """What was read and measured of a dataset.

    Attributes:
        returns: the document of `inspect returns --json`.
        tasks: the document of `inspect tasks --json`.
        endings: of the episodes of all parts, with their returns.
        paths: of the first, the middle and the last snapshot of the shown tasks.
    """

    dataset: Dataset
    summary: dict[str, Any]
    returns: dict[str, Any]
    tasks: dict[str, Any]
    shown: Sequence[Task]
    plane: "Plane"
    quality: Quality
    coverage: Coverage
    rewards: Rewards
    visits: "StateVisits"
    actions: "ActionCounts"
    endings: "EpisodeCounts"
    paths: "Paths"
    browsed: list["Browsed"]
    transfer: Transfer | None


def measure(
    dataset: Dataset,
    *,
    browsed: int,
    transfer: bool = False,
    progress: StageProgress | None = None,
) -> Content:
    """Reads a dataset part by part.

    Args:
        dataset: the dataset; of an incomplete one, what is there.
        browsed: number of whole episodes to keep, of different parts.
        progress: called with the stage, the amount done and the total; every part is read three times.

    Raises:
        SelectionError: it has no parts, or too few tasks for `transfer`.
    """
    entries = [entry for task in dataset.tasks for entry in dataset.parts.entries_of(task.index)]
    if not entries:
        raise SelectionError(f"{dataset.path} has no parts to report; build it with `tcmrl-data build`")
    keys = [entry.key for entry in entries]

    def progress_of(stage: str, before: int = 0, passes: int = 1) -> Callable[[int, int], None]:
        def report(done: int, total: int) -> None:
            if progress is not None:
                progress(stage, before * total + done, passes * total)

        return report

    shown = evenly_spread([task for task in dataset.tasks if dataset.parts.keys_of(task.index)], SHOWN_TASKS)
    plane = choose_plane(dataset, keys)
    visits = StateVisits(plane, [task.index for task in shown])
    actions = ActionCounts()
    endings = EpisodeCounts(min(entry.min for entry in entries), max(entry.max for entry in entries))
    paths = Paths(
        plane, [key for task in shown for key in evenly_spread(dataset.parts.keys_of(task.index), 3)]
    )
    chosen = evenly_spread(keys, browsed)
    whole: list[Browsed] = []
    for done, key in enumerate(keys, start=1):
        episodes = dataset.trajectories(*key)
        for measured in (visits, actions, endings, paths):
            measured.add(key, episodes)
        if key in chosen:
            whole.append(_browsed(key, len(whole) % len(episodes), episodes))
        progress_of("reading", 0, 3)(done, len(keys))
    return Content(
        dataset,
        dataset_summary(dataset),
        list_returns(dataset),
        list_tasks(dataset),
        shown,
        plane,
        measure_quality(dataset),
        measure_coverage(dataset, progress=progress_of("reading", 1, 3)),
        measure_rewards(dataset, progress=progress_of("reading", 2, 3)),
        visits,
        actions,
        endings,
        paths,
        whole,
        measure_transfer(dataset, progress=progress_of("playing")) if transfer else None,
    )


@dataclass(frozen=True)
class Plane:
    """A projection of observations to the two coordinates in which a report draws states.

    Attributes:
        matrix: (observation_dim, 2).
        center: (observation_dim,), subtracted before.
        low: (2,), lower borders of what is drawn.
        high: (2,), upper borders.
        explained: share of the variance that two principal components keep; None of two columns.
    """

    names: tuple[str, str]
    matrix: FloatArray
    center: FloatArray
    low: FloatArray
    high: FloatArray
    explained: float | None

    def project(self, observations: FloatArray) -> FloatArray:
        """Coordinates (rows, 2) of observations (rows, observation_dim)."""
        points: FloatArray = (observations.astype(np.float64) - self.center) @ self.matrix
        return points


def choose_plane(dataset: Dataset, keys: Sequence[PartKey]) -> Plane:
    """The environment's plane, or that of two principal components of the standardized observations.

    Args:
        keys: of its parts, at least one; some rows of some are read.
    """
    states = np.concatenate([_sampled_states(dataset, key) for key in evenly_spread(keys, SAMPLED_PARTS)])
    width = states.shape[1]
    states = states[np.isfinite(states).all(axis=1)]
    try:
        named = dataset.environment.plane
    except TcmrlError:  # the environment is not installed
        named = None
    matrix: FloatArray = np.eye(width, 2)
    center: FloatArray = np.zeros(width)
    names, explained = named or ("first principal component", "second principal component"), None
    if (named is None or width < 2) and len(states) > 1:
        matrix, center, explained = _principal_components(states)
    points = (states - center) @ matrix
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))
    room = np.where(high > low, BORDER * (high - low), 1.0)
    return Plane(names, matrix, center, low - room, high + room, explained)


def _sampled_states(dataset: Dataset, key: PartKey) -> FloatArray:
    rows = dataset.arrays(*key, names=["observations"])["observations"]
    found: FloatArray = rows[evenly_spread(range(len(rows)), SAMPLED_STATES)].astype(np.float64)
    return found


def _principal_components(states: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Matrix, center and share of the variance of two principal components of standardized states."""
    from sklearn.decomposition import PCA
    from sklearn.preprocessing import StandardScaler

    scaler = StandardScaler().fit(states)
    with np.errstate(invalid="ignore"):  # of states that do not vary
        found = PCA(min(2, *states.shape)).fit(scaler.transform(states))
    matrix = np.zeros((states.shape[1], 2))
    matrix[:, : len(found.components_)] = (found.components_ / scaler.scale_).T
    return matrix, scaler.mean_, float(np.nan_to_num(found.explained_variance_ratio_).sum())


@final
class StateVisits:
    """How often the states of a task were visited, as cells of the plane.

    Attributes:
        counts: by task: (BINS, BINS), rows along the second coordinate.
        outside: number of states beyond the plane's borders.
    """

    def __init__(self, plane: Plane, tasks: Sequence[int]) -> None:
        self._plane = plane
        self.counts: dict[int, _Counts] = {task: np.zeros((BINS, BINS), np.int64) for task in tasks}
        self.outside = self.total = 0

    def add(self, key: PartKey, episodes: _Episodes) -> None:
        """Counts a part in."""
        if key.task not in self.counts:
            return
        points = self._plane.project(np.concatenate([episode.observations for episode in episodes]))
        with np.errstate(invalid="ignore"):
            cells = np.floor((points - self._plane.low) / (self._plane.high - self._plane.low) * BINS)
        inside = np.isfinite(cells).all(axis=1) & ((cells >= 0) & (cells < BINS)).all(axis=1)
        x, y = cells[inside].astype(np.int64).T
        self.counts[key.task] += np.bincount(y * BINS + x, minlength=BINS * BINS).reshape(BINS, BINS)
        self.outside += int((~inside).sum())
        self.total += len(points)


@final
class ActionCounts:
    """How often actions were taken, by snapshot step.

    Attributes:
        counts: by step: (action columns, ACTION_BINS) over [-1, 1]; what lies beyond counts at the ends.
        saturated: by step: number of values of at least SATURATED in size.
    """

    def __init__(self) -> None:
        self.counts: dict[int, _Counts] = {}
        self.saturated: dict[int, int] = {}

    def add(self, key: PartKey, episodes: _Episodes) -> None:
        """Counts a part in."""
        actions = np.concatenate([episode.actions for episode in episodes])
        columns = actions.shape[1]
        bins = np.clip((np.nan_to_num(actions) + 1.0) * (ACTION_BINS / 2), 0, ACTION_BINS - 1)
        flat = (bins.astype(np.int64) + np.arange(columns) * ACTION_BINS).ravel()
        counts = np.bincount(flat, minlength=columns * ACTION_BINS).reshape(columns, ACTION_BINS)
        self.counts[key.step] = self.counts.get(key.step, 0) + counts
        saturated = int((np.abs(actions) >= SATURATED).sum())
        self.saturated[key.step] = self.saturated.get(key.step, 0) + saturated

    def saturated_share(self, step: int) -> float:
        """Share of the values of a step that are saturated."""
        return self.saturated[step] / max(1, int(self.counts[step].sum()))


@dataclass
class StepEndings:
    """Episodes of one snapshot step.

    Attributes:
        returns: number of episodes by return, in the bins of `EpisodeCounts.edges`.
    """

    episodes: int = 0
    terminated: int = 0
    truncated: int = 0
    shortest: int = np.iinfo(np.int64).max
    longest: int = 0
    steps: int = 0
    returns: _Counts = field(default_factory=lambda: np.zeros(RETURN_BINS, np.int64))


@final
class EpisodeCounts:
    """Lengths, endings and returns of episodes, by snapshot step.

    Args:
        low: smallest return of an episode in the dataset.

    Attributes:
        edges: (RETURN_BINS + 1,) borders of the bins of returns.
    """

    def __init__(self, low: float, high: float) -> None:
        self.edges: FloatArray = np.linspace(low, high if high > low else low + 1.0, RETURN_BINS + 1)
        self.by_step: dict[int, StepEndings] = {}

    def add(self, key: PartKey, episodes: _Episodes) -> None:
        """Counts a part in."""
        found = self.by_step.setdefault(key.step, StepEndings())
        lengths = [len(episode) for episode in episodes]
        found.episodes += len(episodes)
        found.steps += sum(lengths)
        found.shortest = min(found.shortest, *lengths)
        found.longest = max(found.longest, *lengths)
        found.terminated += sum(bool(episode.terminated.any()) for episode in episodes)
        found.truncated += sum(bool(episode.truncated.any()) for episode in episodes)
        returns = [episode.undiscounted_return for episode in episodes]
        found.returns += np.histogram(np.clip(returns, self.edges[0], self.edges[-1]), self.edges)[0]


@final
class Paths:
    """The first episodes of chosen parts, as paths through the plane.

    Attributes:
        found: by part: (points, 2), float32, with a row of NaN behind every episode.
    """

    def __init__(self, plane: Plane, keys: Sequence[PartKey]) -> None:
        self._plane, self._keys = plane, frozenset(keys)
        self.found: dict[PartKey, FloatArray] = {}

    def add(self, key: PartKey, episodes: _Episodes) -> None:
        """Keeps the paths of a chosen part."""
        if key not in self._keys:
            return
        pieces = []
        for episode in episodes[:PATHS]:
            points = self._plane.project(episode.observations)
            pieces += [points[evenly_spread(range(len(points)), PATH_POINTS)], np.full((1, 2), np.nan)]
        self.found[key] = np.concatenate(pieces).astype(np.float32)


@dataclass(frozen=True)
class Browsed:
    """An episode to browse.

    Attributes:
        ended: how it ended: terminated, truncated, or cut where neither is stored.
        steps: (rows,) of the drawn steps.
        rewards: (rows,).
        observations: (rows, drawn columns).
        actions: (rows, drawn columns).
        columns: number of observation columns and of action columns, drawn or not.
    """

    key: PartKey
    number: int
    length: int
    total: float
    ended: str
    steps: FloatArray
    rewards: FloatArray
    observations: FloatArray
    actions: FloatArray
    columns: tuple[int, int]


def _browsed(key: PartKey, number: int, episodes: _Episodes) -> Browsed:
    episode = episodes[number]
    rows = np.array(evenly_spread(range(len(episode)), BROWSED_STEPS), np.int64)
    cut = "truncated" if episode.truncated.any() else "cut"
    return Browsed(
        key,
        number,
        len(episode),
        episode.undiscounted_return,
        "terminated" if episode.terminated.any() else cut,
        rows.astype(np.float32),
        episode.rewards[rows].astype(np.float32),
        episode.observations[rows, :BROWSED_COLUMNS].astype(np.float32),
        episode.actions[rows, :BROWSED_COLUMNS].astype(np.float32),
        (episode.observations.shape[1], episode.actions.shape[1]),
    )
