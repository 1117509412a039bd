import json
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tcmrl_data.envs.base import ENVIRONMENTS, draw_tasks
from tcmrl_data.envs.rollout import UniformController
from tcmrl_data.envs.simulation import SimulatedTask
from tests.environments import actions_of, environment_of, episodes, parameters_of, play, some_members

NAMES = [name for family in ENVIRONMENTS.working().values() for name in some_members(family)]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("view", ["stored", "full"])
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_gymnasium_accepts_the_environment(name: str, view: Any) -> None:
    environment = environment_of(name)
    env = environment.make(parameters_of(name)[0], view=view)
    env.unwrapped.spec = None  # how Gymnasium's registry would make it is no matter here
    check_env(env, skip_render_check=True)
    assert env.observation_space.shape == (environment.observation_dim,)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (environment.action_dim,), np.float32)
    env.close()


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_depends_on_seed_and_actions_only(name: str) -> None:
    environment = environment_of(name)
    task, actions = parameters_of(name)[1], actions_of(environment)
    env = environment.make(task)
    first = play(env, actions, seed=7)
    for seed in range(20):
        play(env, actions_of(environment, seed=seed, steps=60), seed=seed)
    env.reset(seed=3)
    assert play(env, actions, seed=7) == first
    assert play(environment.make(task), actions, seed=7) == first


@pytest.mark.parametrize("name", NAMES)
def test_one_lane_starts_anew_while_the_others_go_on(name: str) -> None:
    environment = environment_of(name)
    tasks, actions = parameters_of(name)[:2], actions_of(environment)
    lanes, everywhere = environment.lanes(tasks, reward="dense"), np.ones(2, dtype=bool)
    lanes.reset([7, 8])
    lanes.step(np.stack([actions[0], actions[0]]), everywhere)
    first = lanes.reset_lane(0, 9)
    step = lanes.step(np.stack([actions[0], actions[1]]), everywhere)
    for lane, seed, played in ((0, 9, actions[:1]), (1, 8, actions[:2])):
        single = environment.make(tasks[lane], view="full", reward="dense")
        start = single.reset(seed=seed)[0]
        for action in played:
            observation, reward, *_ = single.step(action)
        assert np.array_equal(step.observations[lane], observation)
        assert step.rewards[lane] == reward
        if lane == 0:
            assert np.array_equal(first, start)
        single.close()
    lanes.close()


@pytest.mark.parametrize("name", NAMES)
def test_tasks_and_action_change_the_episode(name: str) -> None:
    environment = environment_of(name)
    tasks, actions = parameters_of(name), actions_of(environment)
    # dense, because a random walk seldom meets a sparse reward
    first, second = (environment.make(tasks[index], reward="dense") for index in (0, 1))
    assert play(first, actions, seed=0)[1:] != play(second, actions, seed=0)[1:]
    assert play(first, -actions, seed=0)[1:] != play(first, actions, seed=0)[1:]


@pytest.mark.parametrize("name", NAMES)
def test_parameters_are_json_and_rebuild_the_task(name: str) -> None:
    environment, parameters = environment_of(name), parameters_of(name)
    restored = json.loads(json.dumps(parameters))
    assert restored == list(parameters)
    tasks = draw_tasks(environment)
    if name == "half-cheetah-dir":  # has two tasks, each once in both splits
        keys = {(task.split, json.dumps(task.parameters)) for task in tasks}
    else:
        keys = {("any", json.dumps(task.parameters)) for task in tasks}
    assert len(keys) == len(tasks) == environment.settings.tasks
    actions = actions_of(environment)
    again = play(environment.make(restored[2]), actions, seed=1)
    assert again == play(environment.make(parameters[2]), actions, seed=1)


@pytest.mark.parametrize("name", NAMES)
def test_split_is_a_partition_that_a_build_seed_cannot_move(name: str) -> None:
    environment = environment_of(name)
    tasks = draw_tasks(environment)
    assert [task.index for task in tasks] == list(range(environment.settings.tasks))
    assert sum(task.split == "train" for task in tasks) == environment.settings.train
    assert tasks == draw_tasks(environment_of(name))
    other = draw_tasks(environment_of(name, "environment.task_seed=1"))
    is_drawn = environment.settings.split != "interpolation"
    assert ([task.split for task in other] != [task.split for task in tasks]) == is_drawn


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_that_does_not_terminate_is_truncated_at_the_horizon(name: str) -> None:
    environment = environment_of(name, "environment.horizon=9")
    for episode in episodes(environment, UniformController(), list(parameters_of(name)[:3])):
        steps = len(episode)
        assert not episode.terminated[:-1].any()
        assert not episode.truncated[:-1].any()
        assert episode.terminated[-1] or steps == 9
        assert episode.truncated[-1] == (steps == 9)


@pytest.mark.parametrize("name", NAMES)
def test_lanes_equal_single_environments(name: str) -> None:
    environment = environment_of(name, "environment.horizon=12")
    tasks = list(parameters_of(name)[:3])
    together = episodes(environment, UniformController(), tasks)
    for lane, task in enumerate(tasks):
        env = environment.make(task, view="stored")
        observation, _ = env.reset(seed=lane)
        assert np.array_equal(together[lane].observations[0], observation.astype(np.float32))
        for t, action in enumerate(together[lane].actions):
            observation, reward, terminated, truncated, info = env.step(action)
            assert np.array_equal(together[lane].observations[t + 1], observation.astype(np.float32))
            assert together[lane].rewards[t] == np.float32(reward)
            assert (together[lane].terminated[t], together[lane].truncated[t]) == (terminated, truncated)
            assert {key: value[t] for key, value in together[lane].extras.items()} == info


@pytest.mark.parametrize("name", NAMES)
def test_actions_beyond_the_box_act_like_its_border(name: str) -> None:
    """Equal but for rounding: an environment may go on in double precision with a border of its own."""
    environment = environment_of(name)
    free, held = (environment.make(parameters_of(name)[0]) for _ in range(2))
    free.reset(seed=0), held.reset(seed=0)
    for action in 3.0 * actions_of(environment):
        observation, reward, *ends, _ = free.step(action)
        expected, expected_reward, *expected_ends, _ = held.step(np.clip(action, -1.0, 1.0))
        np.testing.assert_allclose(observation, expected, rtol=1e-5, atol=1e-7)
        assert (reward, ends) == (pytest.approx(expected_reward, rel=1e-5), expected_ends)
        if any(ends):
            break


@pytest.mark.parametrize("name", NAMES)
def test_fingerprint_is_json_and_names_what_mujoco_simulates(name: str) -> None:
    environment = environment_of(name)
    fingerprint = environment.fingerprint()
    assert json.loads(json.dumps(fingerprint)) == fingerprint == environment_of(name).fingerprint()
    if not isinstance(environment.make(parameters_of(name)[0]), SimulatedTask):
        return
    assert fingerprint["dt"] == pytest.approx(fingerprint["timestep"] * fingerprint["frame_skip"])
    assert len(fingerprint["model_sha256"]) == 64
    assert fingerprint["versions"]["mujoco"] == mujoco.__version__
