"""Ant-Dir and Ant-Goal: tasks, splits, observations, rewards against the simulator's state, and ends."""

import math
from typing import Any

import numpy as np
import pytest

from tcmrl_data.envs.base import draw_tasks
from tests.environments import Still, actions_of, environment_of, episodes, parameters_of


def stock_ant(**settings: Any) -> Any:
    from gymnasium.envs.mujoco.ant_v5 import AntEnv

    return AntEnv(include_cfrc_ext_in_observation=False, terminate_when_unhealthy=False, **settings)


def test_directions_and_goals_are_the_published_ones() -> None:
    """CSRO's `ant_goal.py` and `ant_dir.py` at 7db1efd: angles linspace(0, 2 pi, 41) without its end."""
    directions = [task["direction"] for task in parameters_of("ant-dir")]
    assert len(directions) == 40
    assert directions[:4] == pytest.approx([0.0, 0.1570796327, 0.3141592654, 0.4712388980], abs=1e-10)
    assert directions[20] == pytest.approx(math.pi)
    goals = [task["goal"] for task in parameters_of("ant-goal")]
    assert goals[0] == [2.0, 0.0]
    assert goals[1] == pytest.approx([1.9753766812, 0.3128689301], abs=1e-9)
    assert goals[10] == pytest.approx([0.0, 2.0], abs=1e-9)
    assert np.linalg.norm(goals, axis=1) == pytest.approx(2.0)


@pytest.mark.parametrize("name", ["ant-dir", "ant-goal"])
def test_every_fourth_task_is_tested_as_published(name: str) -> None:
    """CSRO's `launch_experiment.py` at 7db1efd: arange(0, 40, 4) + 2."""
    tested = [task.index for task in draw_tasks(environment_of(name)) if task.split == "test"]
    assert tested == [2, 6, 10, 14, 18, 22, 26, 30, 34, 38]


@pytest.mark.parametrize("reward", ["velocity", "full"])
def test_reward_of_a_direction_is_velocity_along_it(reward: str) -> None:
    environment = environment_of("ant-dir", f"environment.reward={reward}")
    task = parameters_of("ant-dir")[5]  # 45 degrees
    env, stock = environment.make(task), stock_ant()
    assert np.array_equal(env.reset(seed=4)[0], stock.reset(seed=4)[0])
    place = stock.data.body("torso").xpos[:2].copy()
    for action in actions_of(environment):
        observation, found, *_ = env.step(action)
        stock.step(action)
        assert np.array_equal(observation, np.concatenate([stock.data.qpos[2:], stock.data.qvel]))
        moved, place = stock.data.body("torso").xpos[:2] - place, stock.data.body("torso").xpos[:2].copy()
        expected = (moved[0] + moved[1]) / math.sqrt(2.0) / 0.05
        if reward == "full":
            forces = np.clip(stock.data.cfrc_ext, -1.0, 1.0)
            effort = np.sum(action.astype(np.float64) ** 2)
            expected += 1.0 - 0.5 * effort - 5e-4 * np.sum(forces**2)
        assert found == pytest.approx(expected, abs=1e-8)


def test_reward_of_a_goal_is_distance_and_effort() -> None:
    environment = environment_of("ant-goal")
    env = environment.make({"goal": [-1.5, 0.25]})
    stock = stock_ant(exclude_current_positions_from_observation=False)
    assert np.array_equal(env.reset(seed=4)[0], stock.reset(seed=4)[0])
    for action in actions_of(environment):
        observation, reward, *_ = env.step(action)
        stock.step(action)
        assert np.array_equal(observation, np.concatenate([stock.data.qpos, stock.data.qvel]))
        x, y = stock.data.qpos[:2]
        effort = 0.1 * np.sum(action.astype(np.float64) ** 2)
        assert reward == pytest.approx(-abs(x + 1.5) - abs(y - 0.25) - effort, abs=1e-8)


def test_the_contact_cost_of_a_goal_is_an_option() -> None:
    task, action = parameters_of("ant-goal")[0], np.ones(8, dtype=np.float32)
    rewards = []
    for cost in ("0.0", "0.5"):
        environment = environment_of("ant-goal", f"environment.contact_cost={cost}")
        env = environment.make(task)
        env.reset(seed=0)
        rewards.append(sum(float(env.step(action)[1]) for _ in range(20)))
    assert rewards[1] < rewards[0]


def test_standing_still_earns_nothing_without_the_bonus() -> None:
    """With the bonus it earns about 200 in every task, so that a policy need not know its task."""
    tasks = list(parameters_of("ant-dir")[::10])
    returns = {}
    for reward in ("velocity", "full"):
        environment = environment_of("ant-dir", f"environment.reward={reward}")
        played = episodes(environment, Still(), tasks)
        assert [len(episode) for episode in played] == [200] * 4
        returns[reward] = [episode.undiscounted_return for episode in played]
    assert returns["velocity"] == pytest.approx([0.0] * 4, abs=10.0)
    assert returns["full"] == pytest.approx([200.0] * 4, abs=15.0)


@pytest.mark.parametrize("is_terminated", [False, True])
def test_an_ant_that_falls_ends_its_episode_only_where_asked(is_terminated: bool) -> None:
    environment = environment_of(
        "ant-dir", f"environment.terminate_when_unhealthy={str(is_terminated).lower()}"
    )
    env: Any = environment.make(parameters_of("ant-dir")[0])
    env.reset(seed=0)
    simulator = env._simulator
    position = simulator.data.qpos.copy()
    position[2] = 3.0  # in m; healthy are 0.2 to 1
    simulator.set_state(position, simulator.data.qvel.copy())
    assert env.step(np.zeros(8, dtype=np.float32))[2] is is_terminated


def test_tasks_are_ordered_by_their_angle() -> None:
    for name in ("ant-dir", "ant-goal"):
        environment = environment_of(name)
        places = [environment.ordering(task) for task in parameters_of(name)]
        assert places == pytest.approx([index * math.tau / 40 for index in range(40)], abs=1e-9)


def test_the_path_to_a_goal_can_be_drawn() -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    path = np.zeros((3, 29))
    path[:, 0] = [0.0, 0.5, 1.0]
    environment_of("ant-goal").draw_path(axes, {"goal": [2.0, 0.0]}, path, color="tab:red")
    drawn = [line.get_xdata() for line in axes.lines]
    assert [list(xs) for xs in drawn] == [[0.0], [2.0], [0.0, 0.5, 1.0]]  # start, goal, path
