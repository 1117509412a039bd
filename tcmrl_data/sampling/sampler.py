"""Meta-training batches: draws, then one gather per kind."""

import numpy as np
import numpy.typing as npt
import torch

from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_sequence
from tcmrl_data.sampling.batch import Batch, BatchSizes, Moments, Steps
from tcmrl_data.sampling.draws import Draws
from tcmrl_data.sampling.gather import Gatherer
from tcmrl_data.sampling.moments import moments_of
from tcmrl_data.sampling.prefetch import Prefetch
from tcmrl_data.sampling.rows import Rows

__all__ = ["Batch", "BatchSizes", "Moments", "Sampler", "Steps"]


class Sampler:
    """Serves batch n as a pure function of (seed, stream, n); made by `Selection.sampler`.

    Within a batch, tasks are drawn without replacement; within a task, transitions and windows uniformly
    over all valid ones (with replacement), trajectories uniformly without replacement, so that context
    and execution trajectories differ. Episodes without a step are never drawn, trajectories shorter than
    K hold no window. Task parameters are never loaded.

    On a CUDA device the rows live there if they take at most half of its free memory; otherwise batches
    are gathered in page-locked memory and copied without blocking.

    Attributes:
        sizes: what a batch holds.
        device: where batches are.

    Args:
        rows: the packed selection.
        sizes: what a batch holds.
        seed: of the run.
        stream: further streams of the same seed, independent of each other.
        environment: its name, part of the seed's key.
        place: names the selection in errors.
        device: a torch device.

    Raises:
        SelectionError: a task has too few trajectories, or no window where windows are asked for.
    """

    def __init__(
        self,
        rows: Rows,
        sizes: BatchSizes,
        *,
        seed: int,
        stream: int = 0,
        environment: str,
        place: str,
        device: str = "cpu",
    ) -> None:
        self.sizes, self.device = sizes, torch.device(device)
        self._rows = rows
        sequence = keyed_sequence(seed, environment, NO_TASK, Purpose.SAMPLER, stream)
        self._draws = Draws(rows.episodes, sizes, key=sequence.generate_state(2, np.uint64))
        self._check(place)
        self.num_tasks = self._draws.num_tasks
        self._gather = Gatherer(rows, sizes, num_tasks=self.num_tasks, device=self.device)

    @property
    def task_indices(self) -> npt.NDArray[np.int64]:
        """(tasks,) indices of the tasks that batches are drawn from."""
        return self._rows.task_indices

    @property
    def short_trajectories(self) -> int:
        """How many trajectories are shorter than K, and so hold no window."""
        return int((self._rows.episodes.lengths < self.sizes.window_length).sum())

    def _check(self, place: str) -> None:
        needed = max(self.sizes.context_trajectories) + self.sizes.execution_trajectories
        counts = np.diff(self._rows.episodes.task_ranges)[:, 0]
        for task, count, windows in zip(self.task_indices, counts, self._draws.num_windows, strict=True):
            if count < needed:
                raise SelectionError(
                    f"{place}: task {task} has {count} selected trajectories, a batch takes {needed}"
                )
            if self.sizes.windows and not windows:
                length = self.sizes.window_length
                raise SelectionError(f"{place}: task {task} has no trajectory of {length} steps for a window")

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0; the same for the same selection, sizes, seed and stream."""
        return self._gather(self._draws(n))

    def prefetch(self, first: int, last: int, *, depth: int = 2) -> Prefetch[Batch]:
        """Batches `first` to `last - 1`, made ahead by a thread: a context manager and an iterator.

        Args:
            first: number of the first batch.
            last: one beyond the last.
            depth: batches that wait at most; 0 makes each when it is asked for.
        """
        return Prefetch(self.batch, range(first, last), depth=depth)

    def moments(self) -> Moments:
        """Statistics over all selected transitions."""
        return moments_of(self._rows)
