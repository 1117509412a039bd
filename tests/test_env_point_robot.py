"""The point robots: tasks, steps, rewards, oracles."""

import numpy as np
import pytest

from tests.environments import Still, environment_of, episodes, parameters_of


def test_winds_are_drawn_as_the_field_draws_them() -> None:
    first = parameters_of("point-robot-wind")[0]
    assert first["goal"] == [1.0, 0.0]
    assert first["wind"] == pytest.approx([-0.02380, 0.03360], abs=5e-6)
    assert np.abs([task["wind"] for task in parameters_of("point-robot-wind")]).max() <= 0.05


def test_goals_lie_on_the_half_circle() -> None:
    goals = np.array([task["goal"] for task in parameters_of("point-robot")])
    assert goals[[0, -1]] == pytest.approx(np.array([[1.0, 0.0], [-1.0, 0.0]]))
    assert np.linalg.norm(goals, axis=1) == pytest.approx(1.0)
    assert goals[33] == pytest.approx([0.5, np.sqrt(0.75)])  # a third of the way, 60 degrees


def test_point_robot_moves_by_a_tenth_and_wind_adds_to_it() -> None:
    env = environment_of("point-robot-wind").make({"goal": [1.0, 0.0], "wind": [0.05, -0.02]})
    assert env.reset(seed=0)[0].tolist() == [0.0, 0.0]
    observation, reward, *_ = env.step(np.array([1.0, -0.5], dtype=np.float32))
    assert observation == pytest.approx([0.15, -0.07])
    assert reward == pytest.approx(-np.hypot(0.85, 0.07))


@pytest.mark.parametrize(
    ("reading", "inside", "oracle"), [("distance", 0.9, 13.37), ("normalized", 0.5, 12.47)]
)
def test_sparse_rewards_in_both_readings(reading: str, inside: float, oracle: float) -> None:
    environment = environment_of("sparse-point-robot", f"environment.sparse_reward='{reading}'")
    task = {"goal": [0.1, 0.1], "wind": [0.0, 0.0]}
    env, dense = environment.make(task), environment.make(task, reward="dense")
    for variant in (env, dense):
        variant.reset(seed=0)
    right = np.array([1.0, 0.0], dtype=np.float32)
    assert env.step(right)[1] == pytest.approx(inside)  # 0.1 from the goal
    assert dense.step(right)[1] == pytest.approx(-0.1)
    assert env.step(right)[1] == pytest.approx(
        1.0 - np.sqrt(0.02) / (0.2 if reading == "normalized" else 1.0)
    )
    assert env.step(right)[1] == 0.0  # 0.22 away, outside the radius
    tasks = list(parameters_of("sparse-point-robot"))
    controller = environment.oracle(tasks)
    assert controller is not None
    returns = [episode.undiscounted_return for episode in episodes(environment, controller, tasks)]
    # goals at the ends of the half circle pass exactly the radius, where rounding decides on 0.8
    assert np.mean(returns) == pytest.approx(oracle, abs=0.02)


@pytest.mark.parametrize("name", ["point-robot", "point-robot-wind", "sparse-point-robot"])
def test_a_point_robot_never_terminates_not_even_at_its_goal(name: str) -> None:
    environment, tasks = environment_of(name), list(parameters_of(name)[:5])
    controller = environment.oracle(tasks)
    assert controller is not None
    for episode in episodes(environment, controller, tasks):
        assert len(episode) == environment.settings.horizon
        assert not episode.terminated.any()


def test_wind_oracle_and_blindness() -> None:
    environment, tasks = environment_of("point-robot-wind"), list(parameters_of("point-robot-wind"))
    knowing = environment.oracle(tasks)
    blind = environment.oracle([task | {"wind": [0.0, 0.0]} for task in tasks])
    assert knowing is not None and blind is not None
    means = [
        np.mean([episode.undiscounted_return for episode in episodes(environment, controller, tasks)])
        for controller in (knowing, blind, Still())
    ]
    assert means == pytest.approx([-5.11, -5.65, -28.2], abs=0.05)
