"""The stream of batches that a run learns from; contexts may come from other snapshots than transitions."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, final, runtime_checkable

import torch

from tcmrl_algo.training.config import ALGORITHMS, TrainingConfig
from tcmrl_data import Batch, BatchSizes, Dataset, Moments, Sampler, plugin


@runtime_checkable
class Batches(Protocol):
    """A stream of batches; `Sampler` is one."""

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        ...

    def moments(self) -> Moments:
        """Statistics over all transitions that the actor-critic may see."""
        ...

    @property
    def short_trajectories(self) -> int:
        """How many trajectories are shorter than K, and so hold no window."""
        ...


def open_batches(
    dataset: Dataset,
    config: TrainingConfig,
    *,
    seed: int,
    device: torch.device,
    memory_limit: int | None,
    say: Callable[[str], None],
) -> Batches:
    """The stream of batches from the training tasks; arguments as of `train_run`."""
    run = config.settings.run
    sizes: BatchSizes = plugin(ALGORITHMS, "algorithm", run.algorithm).batch_sizes(config.settings)

    def sampler(snapshots: str, sizes: BatchSizes) -> Sampler:
        selection = dataset.select(split="train", snapshots=snapshots)
        return selection.sampler(sizes, seed=seed, device=str(device), memory_limit=memory_limit, say=say)

    reads = max(sizes.context_trajectories) + sizes.execution_trajectories + sizes.windows
    if run.context_snapshots is None or not reads:
        return sampler(run.snapshots, sizes)
    nothing = {"context_trajectories": (0,), "execution_trajectories": 0, "windows": 0}
    return JoinedBatches(
        sampler(run.snapshots, sizes.model_copy(update=nothing)),
        sampler(run.context_snapshots, sizes),  # as many transitions, so that other draws follow them
    )


@final
class JoinedBatches:
    """Transitions from one sampler; context, execution trajectories and windows from another.

    Args:
        transitions: where the actor-critic's transitions come from.
        contexts: where everything else comes from; of the same seed and tasks.
    """

    def __init__(self, transitions: Sampler, contexts: Sampler) -> None:
        self._transitions, self._contexts = transitions, contexts

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        found = self._contexts.batch(n)
        transitions = self._transitions.batch(n)
        assert torch.equal(found.task_indices, transitions.task_indices)
        return replace(found, transitions=transitions.transitions)

    def moments(self) -> Moments:
        """Statistics over the actor-critic's transitions."""
        return self._transitions.moments()

    @property
    def short_trajectories(self) -> int:
        """How many of the contexts' trajectories are shorter than K."""
        return self._contexts.short_trajectories
