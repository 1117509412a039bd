import functools
import json
import pickle
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tcmrl_data import load_recipe
from tcmrl_data.environment import (
    Controller,
    Environment,
    Parameters,
    UniformController,
    environment_types,
    make_environment,
)
from tcmrl_data.errors import TaskError
from tcmrl_data.rollout import roll_out
from tcmrl_data.tasks import draw_tasks
from tcmrl_data.trajectory import Trajectory

ML1_IN_FULL = ("ml1/reach", "ml1/door-close", "ml1/stick-pull")
NAMES = [name for name in environment_types() if not name.startswith("ml1/")] + list(ML1_IN_FULL)
ENDLESS = [name for name in NAMES if "rand-params" not in name]
SIMULATED = [name for name in NAMES if "point-robot" not in name]
STEPS = 25


def environment_of(name: str, *overrides: str) -> Environment:
    return load_recipe(name, overrides=overrides).make_environment()


@functools.cache
def parameters_of(name: str) -> tuple[dict[str, Any], ...]:
    """Task parameters; cached because ML1 takes a second to draw them."""
    settings = environment_of(name).settings
    return tuple(environment_of(name).draw_parameters(settings.tasks, settings.task_seed))


def actions_of(environment: Environment, seed: int = 0, steps: int = STEPS) -> np.ndarray:
    shape = (steps, environment.action_dim)
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)


def play(env: gymnasium.Env[Any, Any], actions: np.ndarray, *, seed: int) -> list[tuple[Any, ...]]:
    """Everything an episode returns, in a form that compares exactly."""
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


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("view", ["stored", "full"])
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is -?infinity")
def test_gymnasium_accepts_the_environment(name: str, view: Any) -> None:
    environment = environment_of(name)
    env = environment.make(parameters_of(name)[0], view=view)
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
    assert len({json.dumps(each) for each in parameters}) == len(parameters) == environment.settings.tasks
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
    assert [task.split for task in other] != [task.split for task in tasks]


@pytest.mark.parametrize("name", ENDLESS)
def test_episodes_end_at_the_horizon_and_never_before(name: str) -> None:
    environment = environment_of(name, "environment.horizon=9")
    (episode,) = episodes(environment, UniformController(), [parameters_of(name)[0]])
    assert len(episode) == 9
    assert not episode.terminated.any()
    assert episode.truncated.tolist() == [False] * 8 + [True]


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
    environment = environment_of(name)
    task, beyond = parameters_of(name)[0], 3.0 * actions_of(environment)
    clipped = play(environment.make(task), np.clip(beyond, -1.0, 1.0), seed=0)
    assert play(environment.make(task), beyond, seed=0) == clipped


@pytest.mark.parametrize("name", SIMULATED)
def test_fingerprint_names_model_step_and_versions(name: str) -> None:
    fingerprint = environment_of(name).fingerprint()
    assert json.loads(json.dumps(fingerprint)) == fingerprint == environment_of(name).fingerprint()
    assert fingerprint["dt"] == pytest.approx(fingerprint["timestep"] * fingerprint["frame_skip"])
    assert len(fingerprint["model_sha256"]) == 64
    assert fingerprint["versions"]["mujoco"] == mujoco.__version__


def test_listing_environments_imports_nothing_heavy() -> None:
    script = (
        "import sys; from tcmrl_data.environment import environment_types; names = environment_types();"
        "heavy = {'mujoco', 'metaworld', 'torch', 'stable_baselines3'} & set(sys.modules);"
        "print(len(names), sorted(heavy))"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert shown.stdout.split(maxsplit=1) == ["56", "[]\n"]


# --- point robots -------------------------------------------------------------------------------------


def test_winds_are_drawn_as_the_field_draws_them() -> None:
    first = parameters_of("point-robot-wind")[0]
    assert first["goal"] == [1.0, 0.0]
    assert first["wind"] == pytest.approx([-0.02380, 0.03360], abs=5e-6)
    assert np.abs([each["wind"] for each in parameters_of("point-robot-wind")]).max() <= 0.05


def test_goals_lie_on_the_half_circle() -> None:
    goals = np.array([each["goal"] for each in parameters_of("point-robot")])
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
    for each in (env, dense):
        each.reset(seed=0)
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
    returns = [each.undiscounted_return for each in episodes(environment, controller, tasks)]
    # goals at the ends of the half circle pass exactly the radius, where rounding decides on 0.8
    assert np.mean(returns) == pytest.approx(oracle, abs=0.02)


def test_wind_oracle_and_blindness() -> None:
    environment, tasks = environment_of("point-robot-wind"), list(parameters_of("point-robot-wind"))
    knowing = environment.oracle(tasks)
    blind = environment.oracle([each | {"wind": [0.0, 0.0]} for each in tasks])
    assert knowing is not None and blind is not None
    means = [
        np.mean([each.undiscounted_return for each in episodes(environment, controller, tasks)])
        for controller in (knowing, blind, Still())
    ]
    assert means == pytest.approx([-5.11, -5.65, -28.2], abs=0.05)


class Still(Controller):
    """Never moves."""

    def act(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return np.zeros_like(noise)


# --- half cheetah -------------------------------------------------------------------------------------


def test_a_cheetah_that_stands_still_returns_minus_305() -> None:
    environment, tasks = environment_of("half-cheetah-vel"), list(parameters_of("half-cheetah-vel"))
    velocities = np.array([each["velocity"] for each in tasks])
    assert velocities.min() >= 0.0 and velocities.max() <= 3.0
    returns = [each.undiscounted_return for each in episodes(environment, Still(), tasks)]
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
        make_environment(load_recipe("half-cheetah-vel").environment | {"min_velocity": 3.0})


# --- randomised bodies --------------------------------------------------------------------------------

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
            assert np.array_equal(multipliers, expected)
    published = environment_of(name, "environment.damping_base=1.3").draw_parameters(2, 1337)[1]
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


# --- Meta-World ---------------------------------------------------------------------------------------


def test_the_task_sets_are_meta_worlds() -> None:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    from metaworld.policies import ENV_POLICY_MAP

    names = {f"{name.removeprefix('ml1/')}-v3" for name in environment_types() if name.startswith("ml1/")}
    assert len(names) == 50
    assert names == set(ALL_V3_ENVIRONMENTS) == set(ENV_POLICY_MAP)


@pytest.mark.parametrize("name", [name for name in environment_types() if name.startswith("ml1/")])
def test_every_task_set_has_a_recipe_and_an_expert(name: str) -> None:
    environment = environment_of(name)
    assert environment.name == name
    parameters = {"env_name": f"{name.removeprefix('ml1/')}-v3"}
    expert = environment.scripted([parameters], 0.1)
    assert expert is not None and expert.view == "full"
    actions = expert.act(np.full((1, 39), 0.1), np.ones((1, 4)))
    assert actions.shape == (1, 4) and np.abs(actions).max() <= 1.0


@pytest.mark.parametrize("name", ML1_IN_FULL)
def test_a_task_is_ml1s_without_its_constructor(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import metaworld
    import metaworld.env_dict

    environment, task = environment_of(name), parameters_of(name)[11]
    benchmark: Any = metaworld.ML1
    official_task = benchmark(task["env_name"], seed=1337).train_tasks[11]
    official: Any = metaworld.env_dict.ALL_V3_ENVIRONMENTS[task["env_name"]]()
    official.set_task(official_task)
    assert pickle.loads(official_task.data)["rand_vec"].tolist() == task["rand_vec"]
    monkeypatch.setattr(metaworld, "ML1", None)  # a task must be made without the benchmark
    env = environment.make(task)
    assert np.array_equal(env.reset(seed=0)[0], official.reset()[0])
    for action in actions_of(environment):
        observation, reward, _, _, info = env.step(action)
        expected, official_reward, _, _, official_info = official.step(action)
        assert np.array_equal(observation, expected)
        assert (reward, info["success"]) == (official_reward, bool(official_info["success"]))


@pytest.mark.parametrize("name", ML1_IN_FULL)
def test_the_goal_is_shown_to_policies_and_hidden_from_storage(name: str) -> None:
    environment = environment_of(name, "environment.horizon=5")
    task = parameters_of(name)[0]
    full, _ = environment.make(task, view="full").reset(seed=0)
    stored, _ = environment.make(task).reset(seed=0)
    assert np.any(full[-3:] != 0) and not stored[-3:].any()
    assert np.array_equal(full[:-3], stored[:-3])
    assert np.array_equal(environment.stored_view(full[None]), stored[None])
    assert np.any(full[-3:] != 0)  # hiding works on a copy
    (episode,) = episodes(environment, UniformController(), [task])
    assert not episode.observations[:, -3:].any()


def test_the_expert_succeeds_and_noise_hinders_it() -> None:
    environment = environment_of("ml1/reach", "environment.horizon=150")
    tasks = list(parameters_of("ml1/reach")[:4])
    clean, noisy = (environment.scripted(tasks, noise) for noise in (0.1, 1.0))
    assert clean is not None and noisy is not None
    best = episodes(environment, clean, tasks)
    assert all(episode.extras["success"].any() for episode in best)
    assert best[0].extras["success"].dtype == np.bool_
    hindered = episodes(environment, noisy, tasks)
    returns = [np.mean([each.undiscounted_return for each in group]) for group in (best, hindered)]
    assert returns[0] > returns[1]


def test_expert_noise_is_scaled_and_added_per_action() -> None:
    environment, tasks = environment_of("ml1/reach"), [parameters_of("ml1/reach")[0]] * 2
    observations = np.zeros((2, 39))
    observations[:, -3:] = 0.05  # the expert asks for 5 * 0.05
    noise = np.array([[0.0] * 4, [1.0, -1.0, 30.0, 0.5]])
    expert = environment.scripted(tasks, 0.1)
    assert expert is not None
    assert expert.act(observations, noise) == pytest.approx(
        np.array([[0.25, 0.25, 0.25, 0.0], [0.35, 0.15, 1.0, 0.05]]), abs=1e-6
    )


def test_a_task_of_another_set_is_refused() -> None:
    with pytest.raises(TaskError, match="'reach-v3' is no task of this environment"):
        environment_of("ml1/door-close").make(parameters_of("ml1/reach")[0])


def test_a_horizon_beyond_meta_worlds_own_is_possible() -> None:
    environment = environment_of("ml1/reach", "environment.horizon=510")
    (episode,) = episodes(environment, UniformController(), [parameters_of("ml1/reach")[0]])
    assert len(episode) == 510 and episode.truncated[-1]
