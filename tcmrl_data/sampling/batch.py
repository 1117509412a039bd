"""What meta-training is served: sizes of a batch, the batch itself, statistics of the data."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
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
    """Transitions with any leading shape; observations and next observations share their memory.

    What lies beyond an episode's end is zero, but for the last observation, which may stand there again.

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

    Its tensors are views into one buffer, to be read and not written. The buffer is used again once
    nothing refers to any of them any more, never earlier: batches may be kept.

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


@dataclass(frozen=True)
class Moments:
    """Statistics of the selected transitions, float64; standard deviations are at least 1e-6.

    Attributes:
        observation_mean, observation_std: (observation_dim,).
        delta_mean, delta_std: (observation_dim,), of next observation minus observation.
        action_mean, action_std: (action_dim,).
        reward_mean, reward_std, reward_min, reward_max: per step.
        longest_episode: steps.
    """

    observation_mean: npt.NDArray[np.float64]
    observation_std: npt.NDArray[np.float64]
    delta_mean: npt.NDArray[np.float64]
    delta_std: npt.NDArray[np.float64]
    action_mean: npt.NDArray[np.float64]
    action_std: npt.NDArray[np.float64]
    reward_mean: float
    reward_std: float
    reward_min: float
    reward_max: float
    longest_episode: int
