"""Returns of a few training tasks while a run trains."""

import time
from collections.abc import Mapping
from statistics import fmean
from typing import final

from torch import Tensor

from tcmrl_algo.evaluation.arena import Arena
from tcmrl_algo.training.checkpoint import RunRecord
from tcmrl_algo.training.config import method_of
from tcmrl_algo.training.train import create_algorithm
from tcmrl_data import Dataset
from tcmrl_data.foundation.seeding import evenly_spread

WATCHED = 4
"""Training tasks that are watched, evenly spread; test tasks never are."""


@final
class TrainingWatch:
    """Adapts a copy of the policy to stored trajectories of training tasks, and plays an episode in each.

    The copy has its own networks and its episodes have their own keyed seeds: a run's tensors are the same
    with and without a watch. The tasks are among those trained on, so that the returns say how training
    goes, not how well the policy generalizes.

    Args:
        dataset: that of the run.
        every: training steps between two looks.

    Attributes:
        seconds: that the looks have taken.
    """

    def __init__(self, dataset: Dataset, *, every: int) -> None:
        self._dataset, self.every, self.seconds = dataset, every, 0.0
        self._tasks = evenly_spread(dataset.train_tasks, WATCHED)

    def __call__(self, record: RunRecord, tensors: Mapping[str, Tensor]) -> dict[str, float]:
        """The mean undiscounted return of the watched tasks, and the seconds that it took, as metrics."""
        began = time.perf_counter()
        record = record.model_copy(update={"device": "cpu"})
        algorithm = create_algorithm(record, self._dataset)
        algorithm.load_tensors({name: tensor.detach().cpu().clone() for name, tensor in tensors.items()})
        arena = Arena(
            self._dataset,
            algorithm,
            record.config.settings.run,
            capabilities=method_of(record.config)[0].capabilities,
            seed=record.seed,
        )
        try:
            contexts = [arena.stored(task, draw=0) for task in self._tasks]
            episodes = arena.adapted(self._tasks, contexts, episode=0)
        finally:
            arena.close()
        seconds = time.perf_counter() - began
        self.seconds += seconds
        return {
            "watch/return": fmean(episode.undiscounted_return for episode in episodes),
            "time/watch_seconds": seconds,
        }

    def described(self) -> str:
        """Which tasks are watched, and the returns that theirs compare with."""
        names = ", ".join(str(task.index) for task in self._tasks)
        known = [self._dataset.references(task.index) for task in self._tasks]
        means: dict[str, list[float | None]] = {
            "uniform actions": [found.uniform for found in known],
            "the best stored policy": [found.behavior for found in known],
        }
        compared = [
            f"{name} {fmean(value for value in values if value is not None):.2f}"
            for name, values in means.items()
            if None not in values
        ]
        return f"watching training tasks {names} every {self.every:,} steps: {', '.join(compared)}"
