"""What acts in an environment: a batch of lanes, told of every step that it takes."""

import abc
from dataclasses import dataclass
from typing import Literal, final

import numpy as np

from tcmrl_data.envs.trajectory import BoolArray, FloatArray

View = Literal["stored", "full"]
"""`stored`: what the dataset holds and the meta-learner sees. `full`: with what the task hides too."""


@dataclass(frozen=True)
class Transition:
    """One step of all lanes, with observations in the view of the controller that took it.

    Rows of lanes that are not active repeat the last observation, with zero reward.

    Attributes:
        observations: (lanes, observation_dim), before the step.
        actions: (lanes, action_dim) float32 in [-1, 1], as executed.
        rewards: (lanes,), of the state after the move.
        next_observations: (lanes, observation_dim), after the step.
        terminated: (lanes,) bool; True only where the task itself ended the episode.
        truncated: (lanes,) bool; True where a time limit ended it.
        active: (lanes,) bool; False where the lane's episode had ended before this step.
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    next_observations: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    active: BoolArray


class Controller(abc.ABC):
    """Acts for a batch of lanes; rollouts use this interface of every policy.

    A controller that keeps state acts for one rollout: one episode in every lane.
    """

    view: View = "stored"
    """Which observations the controller is given."""

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        """Noise of one episode, (num_steps, action_dim) float32; standard normal unless overridden."""
        return generator.standard_normal((num_steps, action_dim), dtype=np.float32)

    @abc.abstractmethod
    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        """Actions (lanes, action_dim) for observations (lanes, observation_dim) and this step's noise."""

    def observe(self, transition: Transition) -> None:
        """Receives every step after it was taken; does nothing unless overridden.

        For controllers that adapt within an episode. `tcmrl_data.Recorder` turns transitions into
        trajectories.
        """


@final
class UniformController(Controller):
    """Uniform actions in [-1, 1]."""

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        return generator.uniform(-1.0, 1.0, (num_steps, action_dim)).astype(np.float32)

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        return noise
