"""Half-Cheetah-Dir: two tasks in both splits, reward, observations."""

from typing import Any

import numpy as np
import pytest

from tcmrl_data.envs.tasks import draw_tasks
from tests.environments import Still, actions_of, environment_of, episodes, parameters_of


def test_directions_are_the_published_ones_in_both_splits() -> None:
    """IDAQ and TCMRL list -1, 1, -1, 1, two for training and two for tests; ours has both in either split."""
    tasks = draw_tasks(environment_of("half-cheetah-dir"))
    assert [task.parameters["direction"] for task in tasks] == [-1.0, 1.0, -1.0, 1.0]
    for split in ("train", "test"):
        directions = [task.parameters["direction"] for task in tasks if task.split == split]
        assert sorted(directions) == [-1.0, 1.0]


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_cheetah_reward_is_velocity_in_its_direction_and_effort(direction: float) -> None:
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    environment = environment_of("half-cheetah-dir")
    env = environment.make({"direction": direction})
    stock: Any = HalfCheetahEnv()
    assert np.array_equal(env.reset(seed=4)[0], stock.reset(seed=4)[0])
    x = stock.data.qpos[0]
    for action in actions_of(environment):
        observation, reward, *_ = env.step(action)
        stock.step(action)
        assert np.array_equal(observation, np.concatenate([stock.data.qpos[1:], stock.data.qvel]))
        velocity, x = (stock.data.qpos[0] - x) / 0.05, float(stock.data.qpos[0])
        effort = 0.05 * np.sum(action.astype(np.float64) ** 2)
        assert reward == pytest.approx(direction * velocity - effort, abs=1e-9)


def test_a_cheetah_never_terminates_and_earns_nothing_at_rest() -> None:
    tasks = list(parameters_of("half-cheetah-dir"))
    played = episodes(environment_of("half-cheetah-dir"), Still(), tasks)
    assert [len(episode) for episode in played] == [200] * 4
    assert not any(episode.terminated.any() for episode in played)
    returns = [episode.undiscounted_return for episode in played]
    assert returns == pytest.approx([0.0] * 4, abs=10.0)
