"""The stream of batches that a run learns from; contexts may come from other snapshots than transitions.

A method that requests no transitions learns its policy from trajectories, which are of `run.snapshots` then.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, final, runtime_checkable

import torch

from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_data import (
    Batch,
    BatchRequest,
    Dataset,
    Moments,
    Sampler,
    Transitions,
    open_sampler,
)


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
    stages: StagePlan,
    *,
    seed: int,
    device: torch.device,
    memory_limit: int | None,
    say: Callable[[str], None],
) -> "StagedBatches":
    """The stream of batches from the training tasks; the steps of the selections are loaded once.

    Args:
        run: `snapshots` and `context_snapshots` say which.
        stages: what the batches of every stage hold.
    """

    def sampler(snapshots: str, request: BatchRequest) -> Sampler:
        selection = dataset.select(split="train", snapshots=snapshots)
        return open_sampler(
            selection, request, seed=seed, device=str(device), memory_limit=memory_limit, say=say
        )

    requests = sorted((stage.request for stage in stages), key=lambda request: not request.takes_dense)
    transitions, contexts = split_request(
        requests[0]
    )  # of a stage with dense rewards, so that they are loaded
    halves = [split_request(request) for request in requests]
    reads_both = any(half.kinds for half, _ in halves) and any(half.kinds for _, half in halves)
    if run.context_snapshots is None or not reads_both:
        return StagedBatches(sampler(run.snapshots, requests[0]), stages)
    joined = JoinedBatches(sampler(run.snapshots, transitions), sampler(run.context_snapshots, contexts))
    return StagedBatches(joined, stages)


def split_request(request: BatchRequest) -> tuple[BatchRequest, BatchRequest]:
    """A request of the transitions, and one of the trajectories and windows; kinds draw independently."""
    single = {name: kind for name, kind in request.kinds.items() if isinstance(kind, Transitions)}
    longer = {name: kind for name, kind in request.kinds.items() if name not in single}
    return replace(request, kinds=single), replace(request, kinds=longer)


@final
class JoinedBatches:
    """Transitions from one sampler; trajectories and windows from another.

    Args:
        contexts: where all other kinds come from; of the same seed and tasks.
    """

    def __init__(self, transitions: Sampler, contexts: Sampler) -> None:
        self._transitions, self._contexts = transitions, contexts

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        found = self._contexts.batch(n)
        transitions = self._transitions.batch(n)
        assert torch.equal(found.task_indices, transitions.task_indices)
        return Batch(found.task_indices, {**transitions.steps, **found.steps})

    def with_request(self, request: BatchRequest) -> "JoinedBatches":
        """Batches of another request from the same snapshots."""
        transitions, contexts = split_request(request)
        return JoinedBatches(
            self._transitions.with_request(transitions), self._contexts.with_request(contexts)
        )

    def moments(self) -> Moments:
        """Statistics over the actor-critic's transitions."""
        return self._transitions.moments()

    def short_trajectories(self, length: int) -> int:
        """How many of the contexts' trajectories are shorter than `length`."""
        return self._contexts.short_trajectories(length)


@final
class StagedBatches:
    """The batches of a run: batch n is for training step n + 1, and holds what that step's stage requests."""

    def __init__(self, batches: Batches, stages: StagePlan) -> None:
        self._batches, self._stages = batches, stages
        self._by_stage = {stage.name: batches.with_request(stage.request) for stage in stages}

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0."""
        return self._by_stage[self._stages.at(n + 1).stage].batch(n)

    def moments(self) -> Moments:
        """Statistics over all transitions that the actor-critic may see."""
        return self._batches.moments()

    def short_trajectories(self, length: int) -> int:
        """How many trajectories hold no window of `length` steps."""
        return self._batches.short_trajectories(length)
