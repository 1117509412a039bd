"""Half-Cheetah-Vel and -Dir: tasks, observations, rewards against the simulator's state, standing still."""

from typing import Any

import numpy as np
import pytest

from tcmrl_data import load_recipe
from tcmrl_data.envs.base import draw_tasks, make_environment
from tests.environments import Still, actions_of, environment_of, episodes, parameters_of


def test_directions_are_the_published_ones_in_both_splits() -> None:
    """IDAQ and TCMRL list -1, 1, -1, 1, two for training and two for tests; ours has both in either split."""
    tasks = draw_tasks(environment_of("half-cheetah-dir"))
    assert [task.parameters["direction"] for task in tasks] == [-1.0, 1.0, -1.0, 1.0]
    for split in ("train", "test"):
        directions = [task.parameters["direction"] for task in tasks if task.split == split]
        assert sorted(directions) == [-1.0, 1.0]


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("half-cheetah-vel", {"velocity": 1.25}),
        ("half-cheetah-dir", {"direction": -1.0}),
        ("half-cheetah-dir", {"direction": 1.0}),
    ],
)
def test_the_reward_is_that_of_the_velocity_minus_effort(name: str, task: dict[str, float]) -> None:
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    environment = environment_of(name)
    env = environment.make(task)
    stock: Any = HalfCheetahEnv()
    assert np.array_equal(env.reset(seed=4)[0], stock.reset(seed=4)[0])
    x = stock.data.qpos[0]
    for action in actions_of(environment):
        observation, reward, *_ = env.step(action)
        stock.step(action)
        assert np.array_equal(observation, np.concatenate([stock.data.qpos[1:], stock.data.qvel]))
        velocity, x = (stock.data.qpos[0] - x) / 0.05, float(stock.data.qpos[0])
        earned = -abs(velocity - 1.25) if name == "half-cheetah-vel" else task["direction"] * velocity
        effort = 0.05 * np.sum(action.astype(np.float64) ** 2)
        assert reward == pytest.approx(earned - effort, abs=1e-9)


def test_a_cheetah_that_stands_still_returns_minus_305_with_velocities_and_nothing_with_directions() -> None:
    velocities = np.array([task["velocity"] for task in parameters_of("half-cheetah-vel")])
    assert velocities.min() >= 0.0 and velocities.max() <= 3.0
    returns = {}
    for name in ("half-cheetah-vel", "half-cheetah-dir"):
        played = episodes(environment_of(name), Still(), list(parameters_of(name)))
        assert {len(episode) for episode in played} == {200}
        assert not any(episode.terminated.any() for episode in played)
        returns[name] = [episode.undiscounted_return for episode in played]
    assert np.mean(returns["half-cheetah-vel"]) == pytest.approx(-305, abs=2)
    assert returns["half-cheetah-vel"] == pytest.approx((-200 * velocities).tolist(), abs=30)
    assert returns["half-cheetah-dir"] == pytest.approx([0.0] * 4, abs=10.0)


def test_cheetah_refuses_a_velocity_range_that_is_empty() -> None:
    with pytest.raises(ValueError, match=r"min_velocity \(3.0\) must be below max_velocity"):
        make_environment(load_recipe("half-cheetah-vel").environment.model_dump() | {"min_velocity": 3.0})
