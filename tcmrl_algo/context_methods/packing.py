"""Trajectories of several lanes as one padded block of steps."""

from collections.abc import Sequence

import numpy as np
import torch

from tcmrl_algo.methods.problem import Problem
from tcmrl_data import Steps, Trajectory


def pack(trajectories: Sequence[Sequence[Trajectory]], problem: Problem) -> Steps:
    """Trajectories of several lanes as padded steps (lanes, most trajectories, longest episode).

    Lanes may hold different numbers of trajectories, or none; what is missing is padding.
    """
    shape = (
        len(trajectories),
        max((len(lane) for lane in trajectories), default=0),
        max((len(trajectory) for lane in trajectories for trajectory in lane), default=0),
    )
    observations, following = np.zeros((2, *shape, problem.observation_dim), dtype=np.float32)
    actions = np.zeros((*shape, problem.action_dim), dtype=np.float32)
    rewards, terminated = np.zeros((2, *shape), dtype=np.float32)
    mask = np.zeros(shape, dtype=bool)
    for i, lane in enumerate(trajectories):
        for j, trajectory in enumerate(lane):
            place = (i, j, slice(0, len(trajectory)))
            observations[place] = trajectory.observations[:-1]
            following[place] = trajectory.observations[1:]
            actions[place], rewards[place] = trajectory.actions, trajectory.rewards
            terminated[place], mask[place] = trajectory.terminated, True
    arrays = (observations, actions, rewards, following, terminated, mask)
    return Steps(*(torch.from_numpy(array).to(problem.device) for array in arrays))
