"""What meta-training is served: batches, and statistics of the data."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from torch import Tensor

from tcmrl_data.foundation.errors import RequestError


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
        returns_to_go: (...,) sum over k of gamma^k r_{t+k} to the episode's end, whatever ended it.
        discounts_to_end: (...,) gamma^(T - t), which weighs the value of the final observation.
        final_observations: (..., observation_dim) s_T.
        times: (...,) int64, t.

    The last four are None unless the kind was requested with `returns=True`.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor
    mask: Tensor
    returns_to_go: Tensor | None = None
    discounts_to_end: Tensor | None = None
    final_observations: Tensor | None = None
    times: Tensor | None = None


@dataclass(frozen=True)
class Batch:
    """The n-th batch of a stream, float32.

    Its tensors are views into one buffer, to be read and not written. The buffer is used again once
    nothing refers to any of them any more, never earlier: batches may be kept.

    Attributes:
        task_indices: (tasks,) int64, distinct.
        steps: the requested kinds by name. Leading shapes are (tasks, number) of transitions, (tasks, number,
            length) of windows, each inside one episode, and (tasks, number, longest episode) of
            trajectories, padded at the end.

    Example:
        >>> batch = sampler.batch(0)  # doctest: +SKIP
        >>> batch["context"].rewards.shape  # doctest: +SKIP
        torch.Size([16, 2, 200])
    """

    task_indices: Tensor
    steps: Mapping[str, Steps]

    def __getitem__(self, name: str) -> Steps:
        """The steps of one kind.

        Raises:
            RequestError: the batch's request has no such kind, or a number of 0 for it.
        """
        if name not in self.steps:
            raise RequestError(f"no kind {name!r} in this batch, which holds {self.names()}; request it")
        return self.steps[name]

    def __contains__(self, name: object) -> bool:
        return name in self.steps

    def names(self) -> list[str]:
        """The kinds in the order of the request."""
        return list(self.steps)


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
