"""Environments made by their recipes, and episodes rolled out in them, for the tests of environments."""

import functools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from tcmrl_data import load_recipe
from tcmrl_data.envs.base import Environment, Parameters, draw_tasks
from tcmrl_data.envs.rollout import Controller, Trajectory, roll_out

ML1_IN_FULL = ("ml1/reach", "ml1/door-close", "ml1/stick-pull")
MOST_MEMBERS = 3
STEPS = 25


def some_members(family: type[Environment]) -> list[str]:
    """The family's environments, or three evenly spaced ones of a large family."""
    names = family.members()
    number = min(MOST_MEMBERS, len(names))
    return [names[index * (len(names) - 1) // max(1, number - 1)] for index in range(number)]


def environment_of(name: str, *overrides: str) -> Environment:
    return load_recipe(name, overrides=overrides).make_environment()


@functools.cache
def parameters_of(name: str) -> tuple[dict[str, Any], ...]:
    """Task parameters; cached because ML1 takes a second to draw them."""
    return tuple(dict(task.parameters) for task in draw_tasks(environment_of(name)))


def actions_of(environment: Environment, seed: int = 0, steps: int = STEPS) -> np.ndarray:
    shape = (steps, environment.action_dim)
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)


def play(env: gymnasium.Env[Any, Any], actions: np.ndarray, *, seed: int) -> list[tuple[Any, ...]]:
    """All arrays of an episode, in a form that compares exactly."""
    observation, info = env.reset(seed=seed)
    episode: list[tuple[Any, ...]] = [(observation.tobytes(), info)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        episode.append((observation.tobytes(), reward, terminated, truncated, info))
        if terminated or truncated:
            break
    return episode


def episodes(
    environment: Environment, controller: Controller, tasks: Sequence[Parameters]
) -> list[Trajectory]:
    lanes = environment.lanes(tasks)
    noise = [np.random.default_rng(lane) for lane in range(len(tasks))]
    return roll_out(environment, lanes, controller, reset_seeds=range(len(tasks)), noise=noise)


class Still(Controller):
    """Never moves."""

    def act(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return np.zeros_like(noise)
