"""The stream of batches that a run learns from; contexts may come from other snapshots than transitions."""

from collections.abc import Callable
from typing import Protocol, final, runtime_checkable

import torch

from tcmrl_algo.settings.run import RunSettings
from tcmrl_data import Batch, BatchRequest, Dataset, Moments, Sampler, Transitions, open_sampler


@runtime_checkable
class Batches(Protocol):
    """A stream of batches; `Sampler` is one."""

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        ...

    def with_request(self, request: BatchRequest) -> "Batches":
        """The same stream for another request, of the same snapshots; nothing is loaded again."""
        ...

    def moments(self) -> Moments:
        """Statistics over all transitions that the actor-critic may see."""
        ...

    def short_trajectories(self, length: int) -> int:
        """How many trajectories hold no window of `length` steps."""
        ...


def open_batches(
    dataset: Dataset,
    run: RunSettings,
    request: BatchRequest,
    *,
    seed: int,
    device: torch.device,
    memory_limit: int | None,
    say: Callable[[str], None],
) -> Batches:
    """The stream of batches from the training tasks.

    Args:
        dataset: what to learn from.
        run: `snapshots` and `context_snapshots` say which.
        request: what a batch holds.
        seed: of the run.
        device: where batches are to be.
        memory_limit: as for `train_run`.
        say: as for `train_run`.
    """

    def sampler(snapshots: str, request: BatchRequest) -> Sampler:
        selection = dataset.select(split="train", snapshots=snapshots)
        return open_sampler(
            selection, request, seed=seed, device=str(device), memory_limit=memory_limit, say=say
        )

    transitions = only_transitions(request)
    if run.context_snapshots is None or transitions == request:
        return sampler(run.snapshots, request)
    return JoinedBatches(sampler(run.snapshots, transitions), sampler(run.context_snapshots, request))


def only_transitions(request: BatchRequest) -> BatchRequest:
    """The request's kinds of transitions alone."""
    kinds = {name: kind for name, kind in request.kinds.items() if isinstance(kind, Transitions)}
    return BatchRequest(request.tasks, kinds)


@final
class JoinedBatches:
    """Transitions from one sampler; trajectories and windows from another.

    Args:
        transitions: where kinds of transitions come from.
        contexts: where all other kinds come from; of the same seed and tasks.
    """

    def __init__(self, transitions: Sampler, contexts: Sampler) -> None:
        self._transitions, self._contexts = transitions, contexts

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        found = self._contexts.batch(n)
        transitions = self._transitions.batch(n)
        assert torch.equal(found.task_indices, transitions.task_indices)
        return Batch(found.task_indices, {**found.steps, **transitions.steps})

    def with_request(self, request: BatchRequest) -> "JoinedBatches":
        """Batches of another request from the same snapshots."""
        transitions = self._transitions.with_request(only_transitions(request))
        return JoinedBatches(transitions, self._contexts.with_request(request))

    def moments(self) -> Moments:
        """Statistics over the actor-critic's transitions."""
        return self._transitions.moments()

    def short_trajectories(self, length: int) -> int:
        """How many of the contexts' trajectories are shorter than `length`."""
        return self._contexts.short_trajectories(length)
