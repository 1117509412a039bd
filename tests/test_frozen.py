"""What must not change without a version: tasks, splits, seeds, draws, and files that were made at 922a4af.

Literal values that are the same on every platform. Numbers that a processor rounds in its own way are
compared by `benchmarks/compare_checkouts.py`, which makes them with two checkouts on one machine.
"""

import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tcmrl_algo import evaluate_run, open_run, resume_run
from tcmrl_data import (
    BatchRequest,
    Trajectories,
    Transitions,
    Windows,
    derive_dataset,
    load_recipe,
    open_dataset,
    open_sampler,
    verify_dataset,
)
from tcmrl_data.envs.base import draw_tasks
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed
from tests.sampling import numbered_tasks, sampler_of

FROZEN = Path(__file__).parent / "frozen"


def digest(value: Any) -> str:
    """The head of the SHA-256 of a value's JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


TASKS: dict[str, str] = {
    "ant-dir": "af2f5f44ba19e5a3",
    "ant-goal": "a5fc0720ab6d5bda",
    "half-cheetah-dir": "75b4a9d6220575c6",
    "half-cheetah-vel": "15879b9e9768c611",
    "hopper-rand-params": "be161a0420ce8b12",
    "ml1/button-press-topdown": "d9c74c07e3c00d89",
    "ml1/push": "0b712504efcf246b",
    "ml1/reach": "d3a3af3177b1ddb4",
    "point-robot": "74d4d86da04ec1bf",
    "point-robot-wind": "b1a3d4b915a4431a",
    "sparse-point-robot": "e05e869cbe082f82",
    "walker-rand-params": "b26e7880b3de2603",
}
"""Digests of the index, split and parameters of all tasks."""


@pytest.mark.parametrize("name", TASKS)
def test_tasks_and_splits(name: str) -> None:
    tasks = draw_tasks(load_recipe(name).make_environment())
    assert digest([[task.index, task.split, task.parameters] for task in tasks]) == TASKS[name]


def test_seeds() -> None:
    assert keyed_seed(0, "point-robot", 3, Purpose.BEHAVIOR) == 670347248
    assert keyed_seed(7, "ml1/reach", 49, Purpose.ROLLOUT_RESET, 2, 3) == 1616128475
    numbers = keyed_generator(1, "half-cheetah-vel", 5, Purpose.ROLLOUT_NOISE, 4).integers(10**6, size=4)
    assert numbers.tolist() == [468202, 777095, 980041, 154839]


REQUEST = BatchRequest(
    tasks=3,
    kinds={
        "policy": Transitions(4),
        "context": Trajectories((1, 2)),
        "execution": Trajectories(1, apart_from="context"),
        "windows": Windows(3, length=2),
    },
)
"""Of observations that state the task, the episode and the time step that they come from."""


def drawn(number: int) -> dict[str, list[Any]]:
    """The (task, episode, time step) of the first task's rows in a batch."""
    lengths: Sequence[Sequence[int]] = [[5, 9, 4, 7], [3, 8, 8, 6], [10, 4, 5, 2], [6, 6, 3, 3]]
    batch = sampler_of(numbered_tasks(lengths), REQUEST, seed=11).batch(number)
    first = {"policy": slice(None), "windows": np.s_[:, 0], "context": np.s_[:, 0], "execution": np.s_[:, 0]}
    rows = {name: batch[name].observations[0][place].int().tolist() for name, place in first.items()}
    return {"tasks": batch.task_indices.tolist()} | rows


def test_draws_of_batches() -> None:
    assert drawn(0) == {
        "tasks": [1, 2, 3],
        "policy": [[1, 2, 0], [1, 2, 1], [1, 3, 1], [1, 3, 1]],
        "windows": [[1, 2, 2], [1, 1, 1], [1, 3, 0]],
        "context": [[1, 2, 0]],
        "execution": [[1, 0, 0]],
    }
    assert drawn(1000) == {
        "tasks": [3, 0, 2],
        "policy": [[3, 2, 0], [3, 1, 3], [3, 3, 0], [3, 1, 4]],
        "windows": [[3, 2, 0], [3, 0, 0], [3, 0, 1]],
        "context": [[3, 1, 0]],
        "execution": [[3, 2, 0]],
    }


def test_draws_of_stored_batches() -> None:
    selection = open_dataset(FROZEN / "dataset").select(split="train")
    batch = open_sampler(selection, BatchRequest(2, REQUEST.kinds), seed=2).batch(5)
    values = {name: batch[name].observations.double().sum().item() for name in REQUEST.kinds}
    assert values == pytest.approx(
        {
            "policy": 0.8498458433896303,
            "context": -13.8560823487569,
            "execution": 7.466383846942335,
            "windows": 0.8357360064983368,
        }
    )


def test_draws_of_episodes(tmp_path: Path) -> None:
    derive_dataset(FROZEN / "dataset", tmp_path / "cut", episodes=1, seed=4, snapshots="last")
    whole, cut = open_dataset(FROZEN / "dataset"), open_dataset(tmp_path / "cut")
    for key in cut.parts:
        (kept,) = cut.trajectories(*key)
        found = [np.array_equal(kept.actions, episode.actions) for episode in whole.trajectories(*key)]
        assert found.index(True) == {0: 2, 3: 0, 40: 0}[key.task]


def test_the_dataset_opens_with_its_digests_and_is_whole() -> None:
    dataset = open_dataset(FROZEN / "dataset")
    assert dataset.manifest.root == "1e03bece17203792548b6e97890b9bfdf92d4a790ff2a9cbdf7b89b2caa94241"
    assert [(key.run, key.task, key.step) for key in dataset.parts] == [
        (run, task, step) for task in (0, 3, 40) for run, step in (("main", 0), ("main", 200), ("noisy", 200))
    ]
    assert verify_dataset(dataset.folder, level="deep").findings == ()
    view = open_dataset(FROZEN / "view.json")
    assert view.manifest.root == "e12a90e91794e772ee6713bd3da3908e1056b2188bb33de338cb764bba4d4aaf"


def test_the_run_opens_goes_on_and_is_evaluated(tmp_path: Path) -> None:
    shutil.copytree(FROZEN, tmp_path / "frozen")
    folder = tmp_path / "frozen" / "run"
    run = open_run(folder)
    assert (run.record.seed, run.newest().step) == (0, 50)
    assert run.record.config.method["latent"] == 4
    dataset = open_dataset(tmp_path / "frozen" / "dataset")
    result = evaluate_run(folder, protocol="offline", dataset_path=dataset.folder)
    assert result.mean_final == pytest.approx(-18.034831, abs=0.02)
    assert resume_run(folder, dataset, steps=50).step == 50
