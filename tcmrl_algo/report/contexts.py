"""Contexts and attention weights of finished runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_algo.algorithms.core.context import ContextAlgorithm, attention_of
from tcmrl_algo.experiment.results import ContextMeasures, RunResult
from tcmrl_algo.training.checkpoint import open_run
from tcmrl_algo.training.train import create_algorithm
from tcmrl_data import CheckpointError, Dataset, Task, Trajectory, open_dataset
from tcmrl_data.foundation.seeding import evenly_spread

NUM_TASKS = 20
"""Number of tasks, as in the paper's t-SNE figures (Appendix G.7)."""
PER_TASK = 20
"""Number of trajectories per task; every trajectory gives one context."""
FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TransitionWeights:
    """Attention weights in single trajectories, times their length; uniform attention is 1.

    Attributes:
        zero, nonzero: weights of transitions whose reward is zero or not, from trajectories with both kinds.
        by_step: (steps,), mean over trajectories at every step; NaN if no trajectory has the step.
        example: weights along one trajectory of a test task.
        example_rewards: rewards of that trajectory.
    """

    zero: FloatArray
    nonzero: FloatArray
    by_step: FloatArray
    example: FloatArray
    example_rewards: FloatArray


@final
class Stored:
    """Trajectories of a dataset for contexts: evenly spaced episodes of evenly spaced tasks."""

    def __init__(self, dataset: Dataset, snapshots: str) -> None:
        tasks = sorted((*dataset.train_tasks, *dataset.test_tasks), key=lambda task: task.index)
        self.dataset = dataset
        self.tasks: list[Task] = evenly_spread(tasks, NUM_TASKS)
        self.trajectories: list[list[Trajectory]] = []
        for task in self.tasks:
            found = dataset.select(tasks=[task.index], snapshots=snapshots).trajectories(task.index)
            self.trajectories.append(evenly_spread(found, PER_TASK))

    @property
    def lanes(self) -> list[list[Trajectory]]:
        """One lane per trajectory, ordered by task."""
        return [[trajectory] for episodes in self.trajectories for trajectory in episodes]

    @property
    def labels(self) -> IntArray:
        """The task of every lane, as an index into `tasks`."""
        return np.repeat(np.arange(len(self.tasks)), [len(episodes) for episodes in self.trajectories])


@final
class TrainedContexts:
    """Contexts and attention of one finished run.

    Attributes:
        labels: (trajectories,), task of every trajectory, as an index into the stored tasks.
    """

    def __init__(self, run: RunResult, stored: Stored) -> None:
        assert run.folder is not None
        opened = open_run(run.folder)
        opened.check_dataset(stored.dataset)
        record = opened.record.model_copy(update={"device": "cpu"})
        algorithm = create_algorithm(record, stored.dataset)
        algorithm.load_tensors(opened.newest().tensors())
        self._algorithm, self._stored = algorithm, stored
        self.labels = stored.labels

    @cached_property
    def contexts(self) -> FloatArray | None:
        """Contexts, (trajectories, latent); None if all are equal, or for a method without contexts.

        All are equal where an encoder has collapsed, and where the context is not of trajectories, as the
        privileged control's.
        """
        if not isinstance(self._algorithm, ContextAlgorithm):
            return None
        found: FloatArray = self._algorithm.context(self._stored.lanes).cpu().numpy()
        return found if np.ptp(found, axis=0).any() else None

    @cached_property
    def weights(self) -> TransitionWeights | None:
        """Attention weights; None for a method without attention."""
        attention = attention_of(self._algorithm, self._stored.lanes)
        if attention is None:
            return None
        rows = [
            weights[mask].numpy() * int(mask.sum())
            for weights, mask in zip(attention.weights.cpu(), attention.mask.cpu(), strict=True)
        ]
        return _transition_weights(rows, self._stored)

    def measures(self) -> ContextMeasures:
        """The numbers that a report keeps of the run's contexts and attention."""
        attention = {}
        for kind in ("zero", "nonzero") if self.weights is not None else ():
            weights = getattr(self.weights, kind)
            if len(weights):
                attention[f"attention_{kind}"] = float(weights.mean())
                attention[f"median_{kind}"] = float(np.median(weights))
        separation = {}
        if self.contexts is not None:
            separation["context_ratio"] = distance_ratio(self.contexts, self.labels)
            separation["centroid_accuracy"] = centroid_accuracy(self.contexts, self.labels)
        return ContextMeasures(tasks=len(self._stored.tasks), **separation, **attention)


def distance_ratio(contexts: FloatArray, labels: IntArray) -> float | None:
    """Mean distance within tasks over mean distance between tasks; None if all contexts are equal.

    A ratio below 1 means that the tasks are separated.

    Example:
        >>> import numpy as np
        >>> distance_ratio(np.array([[0.0], [1.0], [4.0], [5.0]]), np.array([0, 0, 1, 1]))
        0.25
    """
    distances = np.linalg.norm(contexts[:, None] - contexts[None], axis=-1)
    same = labels[:, None] == labels[None]
    pairs = ~np.eye(len(labels), dtype=bool)
    between = float(distances[~same].mean()) if (~same).any() else 0.0
    return float(distances[same & pairs].mean()) / between if between and (same & pairs).any() else None


def centroid_accuracy(contexts: FloatArray, labels: IntArray) -> float | None:
    """Share of the contexts whose nearest mean is that of their task's others, not that of another task.

    None if a task has one context only.

    Example:
        >>> import numpy as np
        >>> centroid_accuracy(np.array([[0.0], [1.0], [1.5], [5.0]]), np.array([0, 0, 1, 1]))
        0.75
    """
    members = np.eye(labels.max() + 1)[labels]
    numbers = members.sum(axis=0)
    if numbers.min() < 2:
        return None
    centroids = (members.T @ contexts) / numbers[:, None]
    distances = np.linalg.norm(contexts[:, None] - centroids[None], axis=-1)
    size = numbers[labels]
    rows = np.arange(len(labels))
    distances[rows, labels] *= size / (size - 1)  # without the context itself the centroid lies farther away
    return float((distances.argmin(axis=1) == labels).mean())


def embed(contexts: FloatArray) -> FloatArray:
    """t-SNE (van der Maaten & Hinton, 2008) of contexts with a fixed initial state, (points, 2)."""
    from sklearn.manifold import TSNE

    perplexity = min(30.0, (len(contexts) - 1) / 3)
    result: FloatArray = TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(contexts)
    return result


@final
class Trained:
    """Contexts and attention of finished runs; every run is read once, at its first use."""

    def __init__(self) -> None:
        self._stored: dict[tuple[str, str], Stored] = {}
        self._contexts: dict[Path, TrainedContexts] = {}

    def stored(self, run: RunResult) -> Stored:
        """Trajectories of the dataset that a run was trained on.

        Raises:
            TcmrlError: the dataset was moved or removed.
        """
        place, settings = run.dataset, run.config.settings.run
        snapshots = settings.context_snapshots or settings.snapshots
        if not Path(place).exists():
            raise CheckpointError(f"{place} does not exist; name the dataset's present folder with --dataset")
        if (place, snapshots) not in self._stored:
            self._stored[place, snapshots] = Stored(open_dataset(place), snapshots)
        return self._stored[place, snapshots]

    def contexts(self, run: RunResult) -> TrainedContexts:
        """Contexts and attention of a run.

        Raises:
            TcmrlError: the dataset or the checkpoint of the run was moved or removed.
        """
        assert run.folder is not None
        if run.folder not in self._contexts:
            self._contexts[run.folder] = TrainedContexts(run, self.stored(run))
        return self._contexts[run.folder]


def _transition_weights(rows: Sequence[FloatArray], stored: Stored) -> TransitionWeights:
    trajectories = [lane[0] for lane in stored.lanes]
    zero, nonzero = [], []
    for weights, trajectory in zip(rows, trajectories, strict=True):
        is_zero = np.asarray(trajectory.rewards) == 0.0
        if is_zero.any() and not is_zero.all():
            zero.append(weights[is_zero])
            nonzero.append(weights[~is_zero])
    by_step = np.full((len(rows), max(map(len, rows))), np.nan)
    for row, weights in enumerate(rows):
        by_step[row, : len(weights)] = weights
    test = [lane for lane, task in enumerate(stored.labels) if stored.tasks[task].split == "test"]
    example = max(test or range(len(rows)), key=lambda lane: trajectories[lane].undiscounted_return)
    return TransitionWeights(
        zero=np.concatenate(zero) if zero else np.empty(0),
        nonzero=np.concatenate(nonzero) if nonzero else np.empty(0),
        by_step=np.nanmean(by_step, axis=0),
        example=rows[example],
        example_rewards=np.asarray(trajectories[example].rewards),
    )
