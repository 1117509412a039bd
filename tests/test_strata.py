"""Splits and folds along the ordering of tasks, and the shift between training and test tasks."""

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tcmrl_cli.data import data

from tcmrl_data import Dataset, Task, load_recipe, open_dataset, split_dataset
from tcmrl_data.dataset.listing import ParameterShift, parameter_shifts
from tcmrl_data.envs.base import draw_from_strata, draw_tasks, in_order, middles_of_strata
from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.recipe.recipe import choose_tasks
from tests.commands import in_process
from tests.environments import environment_of
from tests.graded import graded_dataset, graded_recipe

ORDERED = ("half-cheetah-vel", "point-robot", "sparse-point-robot")


def velocities(tasks: Sequence[Task], split: str) -> list[float]:
    return [task.parameters["velocity"] for task in tasks if task.split == split]


@pytest.mark.parametrize("profile", load_recipe("half-cheetah-vel").training)
def test_the_cheetah_trains_and_is_tested_at_equal_mean_velocities(profile: str) -> None:
    tasks = choose_tasks(load_recipe("half-cheetah-vel", profile=profile))  # type: ignore[arg-type]
    means = [np.mean(velocities(tasks, split)) for split in ("train", "test")]
    assert abs(means[1] - means[0]) < 0.1  # m/s; 0.73 with a permutation


@pytest.mark.parametrize("name", ORDERED)
def test_every_stratum_has_one_test_task(name: str) -> None:
    environment = environment_of(name)
    ordered = in_order(environment, draw_tasks(environment))
    places = [environment.ordering(task.parameters) for task in ordered]
    assert places == sorted(places)  # type: ignore[type-var]
    strata = [ordered[start : start + 5] for start in range(0, 100, 5)]
    assert [sum(task.split == "test" for task in stratum) for stratum in strata] == [1] * 20


def test_the_split_by_strata_never_moves() -> None:
    """Recorded values: a change of them mixes training and test tasks of published datasets."""
    tested = [task.index for task in draw_tasks(environment_of("point-robot")) if task.split == "test"]
    assert tested[:10] == [3, 6, 12, 15, 21, 27, 32, 36, 43, 49]
    assert tested[10:] == [50, 58, 62, 67, 74, 76, 82, 87, 94, 95]


def test_a_recipe_can_ask_for_a_permutation() -> None:
    tasks = draw_tasks(environment_of("half-cheetah-vel", "environment.split=permutation"))
    means = [np.mean(velocities(tasks, split)) for split in ("train", "test")]
    assert means == pytest.approx([1.38, 2.11], abs=0.01)


@pytest.mark.parametrize("split", ["strata", "interpolation"])
def test_a_split_along_the_order_needs_one(split: str) -> None:
    message = f"'{split}', but the tasks of point-robot-wind have no order; set it to 'permutation'"
    with pytest.raises(RecipeError, match=message):
        load_recipe("point-robot-wind", overrides=[f"environment.split={split}"])


@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 2**32))
def test_strata_are_consecutive_and_of_equal_size(size: int, number: int, seed: int) -> None:
    number = min(size, number)
    drawn = sorted(draw_from_strata(range(size), number, np.random.default_rng(seed)))
    assert len(drawn) == number
    largest = -(-size // number)
    assert drawn[0] < largest and drawn[-1] >= size - largest
    assert all(after - before < 2 * largest for before, after in pairwise(drawn))


def test_interpolation_tests_the_middle_of_every_stratum() -> None:
    assert middles_of_strata([9, 8, 7, 6, 5, 4], 2) == {8, 5}
    assert middles_of_strata([9, 8, 7, 6, 5], 2) == {8, 6}  # of two and of three tasks
    assert middles_of_strata([9, 8, 7], 3) == {9, 8, 7}


def test_tasks_of_imports_may_lack_what_orders_them() -> None:
    environment = environment_of("half-cheetah-vel")
    known = Task(0, "train", {"velocity": 2.0})
    strangers = [
        Task(1, "test", {}),
        Task(2, "train", {"velocity": "fast"}),
        Task(3, "train", {"velocity": []}),
    ]
    assert in_order(environment, [known, *strangers]) == [*strangers, known]


def folds_of(dataset: Dataset, folder: Path, folds: int) -> list[list[int]]:
    made = split_dataset(dataset, folder, folds=folds, seed=3, views=True)
    return [[task.index for task in open_dataset(report.out).test_tasks] for report in made]


def test_folds_test_tasks_all_along_the_ordering(tmp_path: Path) -> None:
    recipe = load_recipe("half-cheetah-vel", overrides=["rollouts.episodes=4", "rollouts.lanes=1"])
    dataset = graded_dataset(tmp_path / "data", tasks=range(17), scores={0: 0.0}, recipe=recipe)
    folds = folds_of(dataset, tmp_path, 5)
    ordered = [task.index for task in in_order(dataset.environment, dataset.tasks)]
    assert sorted(index for fold in folds for index in fold) == list(range(17))
    for stratum in (ordered[:5], ordered[5:10], ordered[10:15]):
        assert [len(set(fold) & set(stratum)) for fold in folds] == [1] * 5
    assert sorted(len(fold) for fold in folds) == [3, 3, 3, 4, 4]


def test_folds_are_a_permutation_where_the_split_is(tmp_path: Path) -> None:
    recipe = graded_recipe("environment.split=permutation")
    dataset = graded_dataset(tmp_path / "data", tasks=range(10), scores={0: 0.0}, recipe=recipe)
    folds = folds_of(dataset, tmp_path, 5)
    assert sorted(index for fold in folds for index in fold) == list(range(10))
    assert any(sum(index < 5 for index in fold) != 1 for fold in folds)


def test_inspect_tasks_shows_how_test_tasks_differ(tiny: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    call = in_process(data, capsys)
    (shift,) = json.loads(call("inspect", "tasks", tiny.folder, "--json")[1])["shift"]
    angles = np.pi / 99 * np.array([0, 40, 60, 99])
    test = 3 * np.pi / 99
    expected = (angles.mean(), test, test - angles.mean(), (test - angles.mean()) / angles.std())
    assert shift.pop("parameter") == "goal angle (rad)"
    assert list(shift) == ["train", "test", "difference", "standardized"]
    assert list(shift.values()) == pytest.approx(expected, rel=1e-6)
    output = call("inspect", "tasks", tiny.folder)[1]
    assert "means of training and test tasks" in output
    assert " ".join(output.split()).endswith("goal angle (rad) 1.58 0.10 -1.48 -1.31")


def moved(dataset: Dataset, parameters: Sequence[dict[str, object]]) -> Dataset:
    """The dataset with other parameters of its first tasks, in memory only."""
    changed = [replace(task, parameters=new) for task, new in zip(dataset.tasks, parameters, strict=True)]
    dataset.__dict__["tasks"] = tuple(changed)
    return dataset


def test_without_an_ordering_every_number_has_its_shift(tmp_path: Path) -> None:
    recipe = load_recipe("point-robot-wind", overrides=["rollouts.episodes=4", "rollouts.lanes=1"])
    dataset = graded_dataset(tmp_path / "data", tasks=[0, 1, 12], scores={0: 0.0}, recipe=recipe)
    winds = ([1.0, 5.0], [3.0, 5.0], [4.0, 7.0])
    shifts = parameter_shifts(moved(dataset, [{"goal": [1.0, 0.0], "wind": wind} for wind in winds]))
    assert shifts == [  # the goal is that of all tasks; 12 is the test task
        ParameterShift("wind.0", train=2.0, test=4.0, difference=2.0, standardized=2.0),
        ParameterShift("wind.1", train=5.0, test=7.0, difference=2.0, standardized=None),
    ]


@pytest.mark.parametrize("value", ["x", None, [], 10**400, 1e308, True])
def test_no_parameter_of_a_stranger_stops_the_table(tmp_path: Path, value: object) -> None:
    dataset = graded_dataset(tmp_path / "data", scores={0: 0.0})
    tasks = [{"goal": value, "first": value, "second": float(index)} for index in range(4)]
    assert [shift.parameter for shift in parameter_shifts(moved(dataset, tasks))] == ["second"]
