"""Meta-World ML1: task sets, hidden goals, experts."""

import pickle
from typing import Any

import numpy as np
import pytest

from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.envs.rollout import UniformController
from tcmrl_data.foundation.errors import TaskError
from tests.environments import ML1_IN_FULL, actions_of, environment_of, episodes, parameters_of


def test_the_task_sets_are_meta_worlds() -> None:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    from metaworld.policies import ENV_POLICY_MAP

    names = {f"{name.removeprefix('ml1/')}-v3" for name in ENVIRONMENTS.members() if name.startswith("ml1/")}
    assert len(names) == 50
    assert names == set(ALL_V3_ENVIRONMENTS) == set(ENV_POLICY_MAP)


@pytest.mark.parametrize("name", [name for name in ENVIRONMENTS.members() if name.startswith("ml1/")])
def test_every_task_set_has_a_recipe_and_an_expert(name: str) -> None:
    environment = environment_of(name)
    assert environment.name == name
    parameters = {"env_name": f"{name.removeprefix('ml1/')}-v3"}
    expert = environment.scripted([parameters], 0.1)
    assert expert is not None and expert.view == "full"
    actions = expert.act(np.full((1, 39), 0.1), np.ones((1, 4)))
    assert actions.shape == (1, 4) and np.abs(actions).max() <= 1.0


@pytest.mark.check
@pytest.mark.parametrize("name", ML1_IN_FULL)
def test_a_task_is_ml1s_without_its_constructor(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import metaworld
    import metaworld.env_dict

    environment, task = environment_of(name), parameters_of(name)[11]
    benchmark: Any = metaworld.ML1
    official_task = benchmark(task["env_name"], seed=1337).train_tasks[11]
    drawn = pickle.loads(official_task.data)
    assert drawn["rand_vec"].tolist() == pytest.approx(task["rand_vec"], rel=1e-9)
    rounded = drawn | {"rand_vec": np.array(task["rand_vec"])}
    official: Any = metaworld.env_dict.ALL_V3_ENVIRONMENTS[task["env_name"]]()
    official.set_task(official_task._replace(data=pickle.dumps(rounded)))
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
    returns = [np.mean([episode.undiscounted_return for episode in group]) for group in (best, hindered)]
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
    with pytest.raises(TaskError, match="'reach-v3' does not belong to this environment"):
        environment_of("ml1/door-close").make(parameters_of("ml1/reach")[0])


def test_a_horizon_beyond_meta_worlds_own_is_possible() -> None:
    environment = environment_of("ml1/reach", "environment.horizon=510")
    (episode,) = episodes(environment, UniformController(), [parameters_of("ml1/reach")[0]])
    assert len(episode) == 510 and episode.truncated[-1]
