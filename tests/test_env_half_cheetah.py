"""Half-Cheetah-Vel: reward and task distribution."""

from typing import Any

import numpy as np
import pytest

from tcmrl_data import load_recipe
from tcmrl_data.envs.base import (
    make_environment,
)
from tests.environments import Still, actions_of, environment_of, episodes, parameters_of


def test_a_cheetah_that_stands_still_returns_minus_305() -> None:
    environment, tasks = environment_of("half-cheetah-vel"), list(parameters_of("half-cheetah-vel"))
    velocities = np.array([task["velocity"] for task in tasks])
    assert velocities.min() >= 0.0 and velocities.max() <= 3.0
    played = episodes(environment, Still(), tasks)
    assert not any(episode.terminated.any() for episode in played)
    returns = [episode.undiscounted_return for episode in played]
    assert np.mean(returns) == pytest.approx(-305, abs=2)
    assert returns == pytest.approx((-200 * velocities).tolist(), abs=30)


def test_cheetah_reward_is_distance_in_velocity_and_effort() -> None:
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    environment = environment_of("half-cheetah-vel")
    env = environment.make({"velocity": 1.25})
    stock: Any = HalfCheetahEnv()
    assert np.array_equal(env.reset(seed=4)[0], stock.reset(seed=4)[0])
    x = stock.data.qpos[0]
    for action in actions_of(environment):
        observation, reward, *_ = env.step(action)
        expected, _, _, _, info = stock.step(action)
        velocity, x = (info["x_position"] - x) / 0.05, info["x_position"]
        assert np.array_equal(observation, expected)
        effort = 0.05 * np.sum(action.astype(np.float64) ** 2)
        assert reward == pytest.approx(-abs(velocity - 1.25) - effort, abs=1e-9)


def test_cheetah_refuses_a_velocity_range_that_is_empty() -> None:
    with pytest.raises(ValueError, match=r"min_velocity \(3.0\) must be below max_velocity"):
        make_environment(load_recipe("half-cheetah-vel").environment.model_dump() | {"min_velocity": 3.0})
