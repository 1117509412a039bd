"""Meta-training batches, and statistics of the data."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from tcmrl_data.foundation.errors import RequestError


@dataclass(frozen=True)
class Steps:
    """Transitions with any leading shape; observations and next observations share memory.

    Padding after the end of an episode is zero, except that it may repeat the last observation.

    Attributes:
        observations: (..., observation_dim).
        actions: (..., action_dim) in [-1, 1].
        rewards: (...); the dense ones if the kind was requested with `rewards="dense"`.
        next_observations: (..., observation_dim).
        terminated: (...) float, 1 if the task ended the episode, else 0; a time limit is 0.
        mask: (...) bool, False on padding.
        returns_to_go: (...) sum over k of gamma^k r_{t+k} to the end of the episode, for any kind of end.
        discounts_to_end: (...) gamma^(T - t), the weight of the final observation's value; 0 if the task
            ended the episode.
        final_observations: (..., observation_dim), s_T.
        times: (...) int64, t.

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

    def map(self, change: Callable[[Tensor], Tensor]) -> "Steps":
        """The steps with all their tensors changed."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        changed: dict[str, Any] = {
            name: None if value is None else change(value) for name, value in given.items()
        }
        return Steps(**changed)


@dataclass(frozen=True)
class Batch:
    """The n-th batch of a stream, float32.

    Its tensors are views into one buffer and must not be written to. The buffer is reused when no tensor
    refers to it any more, so batches may be kept.

    Attributes:
        task_indices: (tasks,) int64, distinct.
        steps: the requested kinds by name. The leading shape of transitions is (tasks, number), of windows
            (tasks, number, length), and of trajectories, padded at the end, (tasks, number, longest episode).
            A window lies within one episode.

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
            RequestError: the batch's request has no such kind, or asks for 0 of it.
        """
        if name not in self.steps:
            raise RequestError(f"no kind {name!r} in this batch, which holds {self.names()}; request it")
        return self.steps[name]

    def __contains__(self, name: object) -> bool:
        return name in self.steps

    def names(self) -> list[str]:
        """The names of the kinds, in the order of the request."""
        return list(self.steps)


@dataclass(frozen=True)
class Moments:
    """Statistics of the selected transitions, float64; standard deviations are at least 1e-6.

    Attributes:
        observation_mean, observation_std: (observation_dim,).
        delta_mean, delta_std: (observation_dim,), for next observation minus observation.
        action_mean, action_std: (action_dim,).
        reward_mean, reward_std, reward_min, reward_max: statistics of the reward per step.
        dense_reward_range: smallest and largest dense reward per step; None if dense rewards are not loaded.
        longest_episode: length of the longest episode in steps.
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
    dense_reward_range: tuple[float, float] | None = None
