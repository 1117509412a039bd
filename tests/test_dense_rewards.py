"""Dense rewards beside sparse ones: in episodes, parts, batches, the cache and the actor-critic."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tcmrl_algo import METHODS, TrainingSettings, resolve, train_run
from tcmrl_algo.algorithms.core.actor_critic.base import value_bounds
from tcmrl_algo.algorithms.core.problem import Stage, StagePlan
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_data import (
    BatchRequest,
    Dataset,
    TrainingError,
    Trajectories,
    Trajectory,
    Transitions,
    Windows,
    build_dataset,
    load_recipe,
    open_dataset,
    open_sampler,
    verify_dataset,
)
from tcmrl_data.envs.base import DENSE_REWARDS
from tcmrl_data.envs.rollout import UniformController
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.recipe.recipe import full_settings
from tcmrl_data.sampling.cache import cached_rows, list_cache
from tcmrl_data.sampling.rows import read_rows
from tests.environments import environment_of, episodes, parameters_of
from tests.graded import graded_dataset
from tests.made_up import problem, settings
from tests.sampling import numbered_tasks, sampler_of
from tests.small_training import small_batches

pytestmark = pytest.mark.usefixtures("module_in_process")

NAME = "sparse-point-robot"
OWN_METHODS = [name for name in METHODS.names() if METHODS.get(name).__module__.startswith("tcmrl_algo.")]
OTHERS = {"context": Trajectories((1, 2)), "windows": Windows(4, length=3)}
DENSE = BatchRequest(3, {"policy": Transitions(40, rewards="dense", returns=True), **OTHERS}, gamma=0.5)
STORED = BatchRequest(3, {"policy": Transitions(40, returns=True), **OTHERS}, gamma=0.5)
LENGTHS = [[5, 9, 4], [3, 8, 8], [10, 4, 5]]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Stored rewards are positive and equal within an episode; dense ones are -1 to -5."""
    small = ("rollouts.episodes=4", "rollouts.lanes=1", "environment.horizon=5")
    recipe = load_recipe(NAME, profile="quick", overrides=small)
    folder = tmp_path_factory.mktemp("dense") / "data"
    return graded_dataset(folder, tasks=range(1, 5), recipe=recipe, dense=True)


def test_episodes_hold_the_distance_beside_the_sparse_reward() -> None:
    tasks = list(parameters_of(NAME)[:4])
    for task, episode in zip(tasks, episodes(environment_of(NAME), UniformController(), tasks), strict=True):
        distances = np.linalg.norm(episode.observations[1:] - np.array(task["goal"]), axis=1)
        dense = episode.extras[DENSE_REWARDS]
        assert dense.dtype == np.float32
        np.testing.assert_allclose(dense, -distances, atol=1e-6)
        np.testing.assert_allclose(episode.rewards, np.where(distances <= 0.2, 1 - distances, 0), atol=1e-6)


def test_recipes_from_before_there_were_dense_rewards_have_none() -> None:
    recorded = load_recipe(NAME).unit_settings()
    assert recorded["environment"].pop("dense_rewards") is True
    assert full_settings(recorded)["environment"]["dense_rewards"] is False
    environment = environment_of(NAME, "environment.dense_rewards=false")
    (episode,) = episodes(environment, UniformController(), list(parameters_of(NAME)[:1]))
    assert episode.extras == {}


def dense_tasks() -> list[list[Trajectory]]:
    """Numbered episodes whose dense reward is -1 minus the stored one."""
    return [
        [
            replace(episode, extras={DENSE_REWARDS: (-1 - episode.rewards).astype(np.float32)})
            for episode in task
        ]
        for task in numbered_tasks(LENGTHS)
    ]


def test_only_the_rewards_of_the_same_transitions_change() -> None:
    dense, stored = (sampler_of(dense_tasks(), request, seed=3) for request in (DENSE, STORED))
    without = sampler_of(numbered_tasks(LENGTHS), STORED, seed=3)
    for n in range(20):
        batches = [sampler.batch(n) for sampler in (dense, stored, without)]
        policy = [batch["policy"] for batch in batches]
        assert torch.equal(policy[0].rewards, -1 - policy[1].rewards)
        for field in ("observations", "actions", "next_observations", "terminated", "times"):
            assert torch.equal(getattr(policy[0], field), getattr(policy[1], field)), field
        for name in ("context", "windows"):
            for field in ("observations", "rewards", "next_observations", "terminated", "mask"):
                found = [getattr(batch[name], field) for batch in batches]
                assert torch.equal(found[0], found[1]) and torch.equal(found[1], found[2]), (name, field)
        assert torch.equal(policy[1].returns_to_go, policy[2].returns_to_go)  # type: ignore[arg-type]


def test_returns_to_go_are_those_of_the_dense_rewards() -> None:
    steps = sampler_of(dense_tasks(), DENSE, seed=3).batch(0)["policy"]
    assert steps.returns_to_go is not None
    for (task, episode, t), found in zip(
        steps.observations.flatten(0, 1).int().tolist(), steps.returns_to_go.flatten().tolist(), strict=True
    ):
        rest = range(t, LENGTHS[task][episode])
        rewards = [-1 - (100 * task + 10 * episode + later) for later in rest]
        assert found == pytest.approx(sum(0.5**k * reward for k, reward in enumerate(rewards)), rel=1e-6)


def test_moments_know_the_range_of_dense_rewards() -> None:
    dense = sampler_of(dense_tasks(), DENSE).moments()
    plain = sampler_of(numbered_tasks(LENGTHS), STORED).moments()
    assert dense.dense_reward_range == (-1 - plain.reward_max, -1 - plain.reward_min)
    assert plain.dense_reward_range is None
    for name, value in vars(plain).items():
        if name != "dense_reward_range":
            np.testing.assert_array_equal(getattr(dense, name), value)


def test_a_dataset_without_dense_rewards_is_named(dataset: Dataset, tiny: Dataset) -> None:
    with pytest.raises(SelectionError, match="has no dense rewards") as caught:
        open_sampler(tiny.select(split="train"), DENSE, seed=0)
    assert str(tiny.path) in str(caught.value)
    stored = open_sampler(dataset.select(split="train"), STORED, seed=0)
    with pytest.raises(SelectionError, match="not loaded"):
        stored.with_request(DENSE)


def test_the_cache_holds_both_kinds_of_rows(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "cache"))
    selection = dataset.select(split="train")
    for dense in (True, False):
        for rows in (cached_rows(selection, dense=dense), cached_rows(selection, dense=dense)):
            assert rows.has_dense == dense
            np.testing.assert_array_equal(rows.table, read_rows(selection, dense=dense).table)
    assert len(list_cache()) == 2
    left = open_sampler(selection, DENSE, seed=1).batch(5)["policy"]
    right = open_sampler(selection, DENSE, seed=1, memory_limit=100).batch(5)["policy"]
    assert torch.equal(left.rewards, right.rewards)
    assert set(left.rewards.flatten().tolist()) == {-1.0, -2.0, -3.0, -4.0, -5.0}


@pytest.mark.parametrize("context_snapshots", [None, "last"])
def test_a_later_stage_may_take_dense_rewards(dataset: Dataset, context_snapshots: str | None) -> None:
    kinds = [OTHERS, {"policy": Transitions(8, rewards="dense")}, {"policy": Transitions(8)}]
    stages = StagePlan([Stage(str(n), 1, BatchRequest(3, kind)) for n, kind in enumerate(kinds)], steps=3)
    batches = small_batches(dataset, RunSettings(context_snapshots=context_snapshots), stages)
    assert batches.batch(0).names() == list(OTHERS)
    assert (batches.batch(1)["policy"].rewards < 0).all()
    assert batches.batch(2)["policy"].rewards.mean() > 0
    assert batches.moments().dense_reward_range == (-5.0, -1.0)


def test_the_bounds_of_v_follow_the_rewards_that_it_learns_from() -> None:
    both = replace(problem(), dense_reward_range=(-5.0, -1.0))
    chosen = {"gamma": 0.5, "reward_scale": 2.0, "entropy": 0.0}
    bounds = {
        rewards: value_bounds(settings(**chosen, rewards=rewards).actor_critic, both)
        for rewards in ("stored", "dense")
    }
    assert bounds == {"stored": (-8.0, 4.0), "dense": (-20.0, -2.0)}  # 2 x reward, 1 or 2 steps
    with pytest.raises(TrainingError, match="batches hold stored rewards only"):
        value_bounds(settings(rewards="dense").actor_critic, problem())


@pytest.mark.parametrize("name", [*OWN_METHODS, "double_stages"])
def test_methods_let_the_actor_critic_alone_learn_from_dense_rewards(name: str) -> None:
    method = METHODS.get(name)
    shared = TrainingSettings.model_validate({"actor_critic": {"rewards": "dense"}})
    kinds = method().batch_request(shared, method.Config()).kinds
    assert {kind: request.rewards for kind, request in kinds.items()} == {
        kind: "dense" if kind == "policy" else "stored" for kind in kinds
    }


@pytest.mark.parametrize("name", ["tcmrl", "no_context"])
def test_training_takes_dense_rewards(dataset: Dataset, tmp_path: Path, name: str) -> None:
    table = dataset.manifest.training["quick"]
    changes = ("run.steps=2", "batch.context_trajectories=[1]", "run.context_snapshots=all")
    digests = set()
    for rewards in ("stored", "dense"):
        config = resolve(
            table, place="quick", algorithm=name, overrides=(*changes, f"actor_critic.rewards={rewards}")
        )
        report = train_run(dataset, tmp_path / rewards, config=config, profile="quick")
        digests.add(report.digest)
    assert len(digests) == 2


@pytest.mark.check
def test_a_build_stores_dense_rewards_that_verify_and_replay(tmp_path: Path) -> None:
    small = (
        "behavior.source=sac",
        "behavior.sac.steps=60",
        "behavior.sac.warmup=50",
        "behavior.sac.snapshots=[0,60]",
        "rollouts.episodes=2",
        "rollouts.lanes=2",
    )
    recipe = load_recipe(NAME, profile="quick", overrides=small)
    assert build_dataset(recipe, tmp_path / "data", tasks=[1, 2]).failed == ()
    built = open_dataset(tmp_path / "data")
    episode = built.trajectories(1, 60)[0]
    goal = np.array(built.task(1).parameters["goal"])
    distances = np.linalg.norm(episode.observations[1:] - goal, axis=1)
    np.testing.assert_allclose(episode.extras[DENSE_REWARDS], -distances, atol=1e-6)
    assert verify_dataset(built.folder, level="deep", replay=2).findings == ()
