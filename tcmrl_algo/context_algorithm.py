"""Methods that adapt through a context: trajectories in, a vector out, a policy conditioned on it."""

import abc
from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tcmrl_algo.networks import Attention
from tcmrl_algo.problem import Algorithm
from tcmrl_data import Controller, Steps, Trajectory


class ContextAlgorithm(Algorithm):
    """A method whose adaptation is a context; subclasses say how it comes about and how it steers."""

    @abc.abstractmethod
    def context(self, trajectories: Sequence[Sequence[Trajectory]]) -> Float[Tensor, "lanes latent"]:
        """One context per lane, of all its trajectories together; at least one trajectory each."""

    @abc.abstractmethod
    def policy(
        self, observations: Float[Tensor, "lanes observation"], context: Float[Tensor, "lanes latent"]
    ) -> Float[Tensor, "lanes action"]:
        """Deterministic actions in [-1, 1]."""

    def attention(self, trajectories: Sequence[Sequence[Trajectory]]) -> Attention | None:
        """How each lane's transitions weigh in its context; None where a method has no attention."""
        return None

    def adapt(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        return ContextController(self, self.context(trajectories))


@final
class ContextController(Controller):
    """Acts under one fixed context per lane."""

    def __init__(self, algorithm: ContextAlgorithm, context: Float[Tensor, "lanes latent"]) -> None:
        self._algorithm, self._context = algorithm, context

    def act(
        self, observations: np.typing.NDArray[np.floating], noise: np.typing.NDArray[np.floating]
    ) -> np.typing.NDArray[np.floating]:
        states = torch.as_tensor(observations, dtype=torch.float32, device=self._context.device)
        actions: np.typing.NDArray[np.floating] = self._algorithm.policy(states, self._context).cpu().numpy()
        return actions


def pack(trajectories: Sequence[Sequence[Trajectory]], device: torch.device) -> Steps:
    """Trajectories of several lanes as padded steps (lanes, most trajectories, longest episode).

    Lanes may hold different numbers of trajectories; what is missing is padding.
    """
    shape = (
        len(trajectories),
        max(len(lane) for lane in trajectories),
        max(len(each) for lane in trajectories for each in lane),
    )
    first = trajectories[0][0]
    observations, following = np.zeros((2, *shape, first.observations.shape[1]), dtype=np.float32)
    actions = np.zeros((*shape, first.actions.shape[1]), dtype=np.float32)
    rewards, terminated = np.zeros((2, *shape), dtype=np.float32)
    mask = np.zeros(shape, dtype=bool)
    for i, lane in enumerate(trajectories):
        for j, each in enumerate(lane):
            place = (i, j, slice(0, len(each)))
            observations[place], following[place] = each.observations[:-1], each.observations[1:]
            actions[place], rewards[place] = each.actions, each.rewards
            terminated[place], mask[place] = each.terminated, True
    arrays = (observations, actions, rewards, following, terminated, mask)
    return Steps(*(torch.from_numpy(each).to(device) for each in arrays))
