"""Meta-training batches: index arithmetic over packed rows, no data touched but by one gather per kind."""

from dataclasses import dataclass

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor


class BatchSizes(BaseModel):
    """What one batch holds.

    Attributes:
        tasks: tasks per batch, drawn without replacement (capped at the selected tasks).
        transitions: transitions per task for the actor-critic.
        context_trajectories: context trajectories per task; one of these numbers is drawn per batch.
        execution_trajectories: execution trajectories per task, never among the context ones.
        windows: K-step windows per task, uniform over all valid windows; 0 for none.
        window_length: K.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tasks: int = Field(default=16, ge=2)
    transitions: int = Field(default=256, ge=1)
    context_trajectories: tuple[int, ...] = Field(default=(1,), min_length=1)
    execution_trajectories: int = Field(default=1, ge=0)
    windows: int = Field(default=0, ge=0)
    window_length: int = Field(default=2, ge=2)


@dataclass(frozen=True)
class Steps:
    """Transitions with any leading shape.

    Attributes:
        observations: (..., observation_dim).
        actions: (..., action_dim) in [-1, 1].
        rewards: (...,).
        next_observations: (..., observation_dim).
        terminated: (...,) float, 1 where the task ended the episode; a time limit is 0.
        mask: (...,) bool, False on padding.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Batch:
    """The n-th batch of a stream, float32.

    Attributes:
        task_indices: (tasks,) int64, distinct.
        transitions: leading shape (tasks, transitions).
        context: leading shape (tasks, context trajectories, longest episode), padded at the end.
        execution: leading shape (tasks, execution trajectories, longest episode), padded at the end.
        windows: leading shape (tasks, windows, K), each inside one episode.
    """

    task_indices: Tensor
    transitions: Steps
    context: Steps
    execution: Steps
    windows: Steps
