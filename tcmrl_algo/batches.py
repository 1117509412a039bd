"""Batches whose contexts come from other snapshots than the transitions that the actor-critic learns from."""

from dataclasses import replace
from typing import Protocol, final

import torch

from tcmrl_data import Batch, BatchSizes, Moments, Sampler, Selection


class Batches(Protocol):
    """A stream of batches; `Sampler` is one."""

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        ...

    def moments(self) -> Moments:
        """Statistics over all transitions that the actor-critic may see."""
        ...


@final
class JoinedBatches:
    """Transitions from one selection; context, execution trajectories and windows from another of its tasks.

    Args:
        transitions: what the actor-critic learns from.
        contexts: what the encoder learns from.
        sizes: what a batch holds.
        seed: of both samplers, which therefore draw the same tasks.
        device: where batches are to be.

    Raises:
        SelectionError: a selection holds too little.
    """

    def __init__(
        self, transitions: Selection, contexts: Selection, sizes: BatchSizes, *, seed: int, device: str
    ) -> None:
        nothing = {"context_trajectories": (0,), "execution_trajectories": 0, "windows": 0}
        self._transitions: Sampler = transitions.sampler(
            sizes.model_copy(update=nothing), seed=seed, device=device
        )
        self._contexts: Sampler = contexts.sampler(
            sizes.model_copy(update={"transitions": 1}), seed=seed, device=device
        )

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        found = self._contexts.batch(n)
        transitions = self._transitions.batch(n)
        assert torch.equal(found.task_indices, transitions.task_indices)
        return replace(found, transitions=transitions.transitions)

    def moments(self) -> Moments:
        """Statistics over the actor-critic's transitions."""
        return self._transitions.moments()
