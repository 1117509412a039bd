"""Families of directions and goals go through the pipeline: built, verified, trained on and evaluated."""

from pathlib import Path

import numpy as np
import pytest

from tcmrl_algo import evaluate_run, train_run
from tcmrl_data import Dataset, build_dataset, load_recipe, open_dataset, relabel_dataset, verify_dataset
from tests.small_training import config_of

SHORT = (
    "environment.horizon=12",
    "behavior.sac.steps=60",
    "behavior.sac.warmup=30",
    "behavior.sac.snapshots=[0,60]",
    "behavior.sac.hidden=[8]",
    "behavior.sac.batch_size=8",
    "behavior.sac.buffer_size=60",
    "rollouts.episodes=4",
    "rollouts.lanes=4",
)
EVALUATED = ("run.episodes=3", "run.random_episodes=1", "run.repeats=1", "run.candidates=2")
TASKS = {"ant-dir": [0, 2, 20], "ant-goal": [0, 2, 20], "half-cheetah-dir": [0, 1, 2, 3]}
"""Tasks that are built; both splits are among them."""

pytestmark = pytest.mark.check


@pytest.fixture(scope="module", params=TASKS)
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp(request.param) / "data"
    recipe = load_recipe(request.param, profile="quick", overrides=SHORT)
    assert build_dataset(recipe, folder, tasks=TASKS[request.param], workers=1).failed == ()
    return open_dataset(folder)


def test_parts_are_verified_and_replayed(dataset: Dataset) -> None:
    assert len(dataset.parts) == 2 * len(TASKS[dataset.name])
    assert verify_dataset(dataset.folder, level="deep", replay=100).findings == ()


def test_tasks_differ_in_rewards_alone(dataset: Dataset, tmp_path: Path) -> None:
    """`relabel` plays the same actions in the other task and refuses other observations."""
    first, *_, last = (task.index for task in dataset.tasks if task.split == "train")
    relabel_dataset(dataset, tmp_path / "out", to=[last], tasks=[first], workers=1)
    made = open_dataset(tmp_path / "out")
    old, new = (made.trajectories(last, 60, "relabelled"), dataset.trajectories(first, 60))
    assert not np.array_equal(old[0].rewards, new[0].rewards)
    if dataset.name != "ant-goal":  # what is earned the other way is lost here, but for efforts
        effort = 0.05 if dataset.name == "half-cheetah-dir" else 0.0
        efforts = effort * np.square(old[0].actions.astype(np.float64)).sum(axis=1)
        assert old[0].rewards + new[0].rewards == pytest.approx(-2.0 * efforts, abs=1e-5)


def test_a_run_is_trained_and_evaluated(dataset: Dataset, tmp_path: Path) -> None:
    config = config_of(dataset, *EVALUATED)
    train_run(dataset, tmp_path / "run", config=config, profile="quick", steps=10)
    result = evaluate_run(tmp_path / "run", protocol="offline")
    tested = [task.index for task in dataset.tasks if task.split == "test"]
    assert [found.task for found in result.tasks] == tested
    assert all(np.isfinite(found.final) for found in result.tasks)
