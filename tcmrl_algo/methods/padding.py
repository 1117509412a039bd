"""Trajectories of several lanes as one padded block of steps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tcmrl_algo.methods.problem import Problem
from tcmrl_data import Steps, Trajectory


def pad_trajectories(
    trajectories: Sequence[Sequence[Trajectory]], problem: Problem, *, gamma: float | None = None
) -> Steps:
    """Trajectories of several lanes as padded steps (lanes, most trajectories, longest episode).

    Lanes may hold different numbers of trajectories, or none; what is missing is padding.

    Args:
        trajectories: of every lane.
        problem: gives sizes and device.
        gamma: discount factor of the returns to go; None leaves out the fields that batches hold only of
            kinds with `returns=True`.
    """
    shape = (
        len(trajectories),
        max((len(lane) for lane in trajectories), default=0),
        max((len(trajectory) for lane in trajectories for trajectory in lane), default=0),
    )
    observations, following, final = np.zeros((3, *shape, problem.observation_dim), dtype=np.float32)
    actions = np.zeros((*shape, problem.action_dim), dtype=np.float32)
    rewards, terminated = np.zeros((2, *shape), dtype=np.float32)
    mask = np.zeros(shape, dtype=bool)
    for i, lane in enumerate(trajectories):
        for j, trajectory in enumerate(lane):
            place = (i, j, slice(0, len(trajectory)))
            observations[place] = trajectory.observations[:-1]
            following[place] = trajectory.observations[1:]
            final[place] = trajectory.observations[-1]
            actions[place], rewards[place] = trajectory.actions, trajectory.rewards
            terminated[place], mask[place] = trajectory.terminated, True
    arrays = (observations, actions, rewards, following, terminated, mask)
    steps = Steps(*(torch.from_numpy(array).to(problem.device) for array in arrays))
    if gamma is None:
        return steps
    return _with_endings(steps, torch.from_numpy(final).to(problem.device), gamma)


def _with_endings(
    steps: Steps, final_observations: Float[Tensor, "lanes trajectories steps observation"], gamma: float
) -> Steps:
    """The steps with G_t = r_t + gamma G_{t+1}, gamma^(T - t), s_T and t; zero on padding.

    In an episode that the task ended, 0 takes the place of gamma^(T - t).
    """
    returns, following = torch.zeros_like(steps.rewards, dtype=torch.float64), torch.zeros(())
    for t in range(returns.shape[-1] - 1, -1, -1):
        returns[..., t] = following = steps.rewards[..., t] + gamma * following
    times = torch.arange(returns.shape[-1], device=returns.device).expand(returns.shape)
    until_end = steps.mask.sum(dim=-1, keepdim=True) - times
    goes_on = steps.mask & ~steps.terminated.bool().any(dim=-1, keepdim=True)
    return replace(
        steps,
        returns_to_go=returns.float(),
        discounts_to_end=torch.where(goes_on, gamma ** until_end.double(), 0.0).float(),
        final_observations=final_observations,
        times=torch.where(steps.mask, times, 0),
    )
