"""Hopper and Walker with random parameters: the scaled bodies."""

from typing import Any

import numpy as np
import pytest

from tcmrl_data.envs.base import draw_tasks
from tcmrl_data.envs.rollout import UniformController
from tcmrl_data.foundation.errors import TaskError
from tests.environments import actions_of, environment_of, episodes, parameters_of

BODIES = ["hopper-rand-params", "walker-rand-params"]
ARRAYS = ["body_mass", "body_inertia", "dof_damping", "geom_friction"]


def model_of(env: Any) -> Any:
    return env._simulator.model


@pytest.mark.parametrize("name", BODIES)
def test_multipliers_come_in_the_fields_order(name: str) -> None:
    random = np.random.RandomState(1337)
    for task in parameters_of(name)[:3]:
        assert list(task) == ARRAYS
        for multipliers in task.values():
            expected = 1.5 ** random.uniform(-3, 3, np.shape(multipliers))
            np.testing.assert_allclose(multipliers, expected, rtol=1e-9)
    published = draw_tasks(environment_of(name, "environment.damping_base=1.3"))[1].parameters
    ours = parameters_of(name)[1]
    assert [key for key in ARRAYS if published[key] != ours[key]] == ["dof_damping"]
    assert np.log(published["dof_damping"]) / np.log(1.3) == pytest.approx(
        np.log(ours["dof_damping"]) / np.log(1.5)
    )


@pytest.mark.parametrize("name", BODIES)
def test_the_body_is_the_nominal_one_scaled_once(name: str) -> None:
    environment, task = environment_of(name), parameters_of(name)[0]
    nominal = environment.simulator().model  # type: ignore[attr-defined]
    for _ in range(3):  # a task made again must not compound
        model = model_of(environment.make(task))
        for array in ARRAYS:
            expected = getattr(nominal, array) * np.array(task[array])
            assert np.array_equal(getattr(model, array), expected)
            assert np.abs(getattr(model, array)).sum() > 0


@pytest.mark.parametrize("name", BODIES)
def test_derived_constants_and_physics_step_follow_the_settings(name: str) -> None:
    task = parameters_of(name)[0]
    recomputed = model_of(environment_of(name).make(task))
    left = model_of(environment_of(name, "environment.constants='nominal'").make(task))
    nominal = environment_of(name).simulator().model  # type: ignore[attr-defined]
    assert np.array_equal(left.body_invweight0, nominal.body_invweight0)
    assert not np.allclose(recomputed.body_invweight0, nominal.body_invweight0)
    assert recomputed.body_subtreemass[1] == pytest.approx(recomputed.body_mass.sum())
    assert environment_of(name).fingerprint()["dt"] == pytest.approx(0.016)
    stock = environment_of(name, "environment.timestep=0.002").fingerprint()
    assert (stock["dt"], stock["constants"]) == (pytest.approx(0.008), "recomputed")


@pytest.mark.parametrize("name", BODIES)
def test_a_falling_robot_terminates_and_keeps_its_bonus(name: str) -> None:
    environment = environment_of(name)
    env = environment.make(parameters_of(name)[0])
    env.reset(seed=0)
    x = env._simulator.data.qpos[0]  # type: ignore[attr-defined]
    for action in actions_of(environment, steps=200):
        _, reward, terminated, truncated, _ = env.step(action)
        position = env._simulator.data.qpos  # type: ignore[attr-defined]
        velocity, x = (position[0] - x) / 0.016, position[0]
        effort = 1e-3 * np.sum(action.astype(np.float64) ** 2)
        assert reward == pytest.approx(velocity + 1.0 - effort)
        height, angle = position[1:3]
        upright = height > 0.7 and abs(angle) < 0.2
        if name.startswith("walker"):
            upright = 0.8 < height < 2.0 and abs(angle) < 1.0
        assert terminated is not upright
        if terminated:
            break
    assert terminated and not truncated


@pytest.mark.parametrize("name", BODIES)
def test_random_actions_stay_finite_in_every_body(name: str) -> None:
    environment = environment_of(name)
    for episode in episodes(environment, UniformController(), list(parameters_of(name))):
        assert np.isfinite(episode.observations).all() and np.isfinite(episode.rewards).all()
        assert episode.terminated[-1] or len(episode) == environment.settings.horizon


def test_multipliers_of_another_body_are_refused() -> None:
    with pytest.raises(TaskError, match=r"body_mass has shape \(8,\), the model needs \(5,\)"):
        environment_of("hopper-rand-params").make(parameters_of("walker-rand-params")[0])
