"""Policies that must not see the task in which they act, and policies without noise."""

from typing import final

import numpy as np

from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.controller import Controller, Transition
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import BoolArray, FloatArray


@final
class BelievingController(Controller):
    """Another controller that keeps seeing the hidden entries of its own task, whatever the task is.

    Args:
        controller: whose actions these are.
        hidden: (observation_dim,) bool, entries of full observations to replace.
        values: (observation_dim,), what to replace them by.
    """

    def __init__(self, controller: Controller, hidden: BoolArray, values: FloatArray) -> None:
        self.view = controller.view
        self._controller, self._hidden, self._values = controller, hidden, values

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        return self._controller.draw_noise(generator, num_steps, action_dim)

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        if self.view == "full":
            observations = np.where(self._hidden, self._values, observations)
        return self._controller.act(observations, noise)

    def observe(self, transition: Transition) -> None:
        self._controller.observe(transition)


@final
class DeterministicController(Controller):
    """Another controller without its noise, which for a Gaussian policy is its most likely action."""

    def __init__(self, controller: Controller) -> None:
        self.view = controller.view
        self._controller = controller

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        return np.zeros((num_steps, action_dim), dtype=np.float32)

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        return self._controller.act(observations, noise)

    def observe(self, transition: Transition) -> None:
        self._controller.observe(transition)


def hidden_entries(environment: Environment) -> BoolArray:
    """(observation_dim,), entries of full observations that the stored view hides."""
    shown = np.ones(environment.observation_dim)
    found: BoolArray = environment.stored_view(shown) != shown
    return found


def first_observation(environment: Environment, task: Task) -> FloatArray:
    """(observation_dim,), the full observation after a reset; hidden entries tell the task."""
    lanes = environment.lanes([task.parameters])
    try:
        found: FloatArray = lanes.reset([0])[0]
        return found
    finally:
        lanes.close()
