import json
import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcmrl_data import load_recipe
from tcmrl_data.envs.base import ENVIRONMENTS, PARAMETER_DIGITS, Task, draw_tasks
from tcmrl_data.foundation.errors import TaskError
from tcmrl_data.recipe.recipe import choose_tasks, parse_indices, spread
from tests.environments import environment_of, parameters_of, some_members
from tests.platforms import OTHER_PLATFORMS

ALL_NAMES = [name for family in ENVIRONMENTS.working().values() for name in family.members()]
NAMES = [name for family in ENVIRONMENTS.working().values() for name in some_members(family)]

DRAW = """
import json, sys
from tcmrl_data import load_recipe
from tcmrl_data.envs.base import draw_tasks
for name in sys.argv[1:]:
    tasks = draw_tasks(load_recipe(name).make_environment())
    print(json.dumps([[task.index, task.split, task.parameters] for task in tasks]))
"""


def test_the_split_never_moves() -> None:
    """Recorded values: a change of them mixes training and test tasks of published datasets."""
    tasks = draw_tasks(load_recipe("point-robot-wind").make_environment())
    assert [task.index for task in tasks if task.split == "test"] == [12, 15, 16, 17, 18, 19, 22, 26, 28, 44]


@pytest.mark.parametrize("platform", OTHER_PLATFORMS)
@pytest.mark.parametrize(
    "names",
    [
        pytest.param(NAMES, marks=pytest.mark.check, id="some"),
        pytest.param(ALL_NAMES, marks=pytest.mark.exhaustive, id="all"),
    ],
)
def test_tasks_are_the_same_bits_on_every_instruction_set(names: list[str], platform: str) -> None:
    """They are drawn by a process with other instruction sets."""
    done = subprocess.run(
        [sys.executable, "-c", DRAW, *names],
        env=os.environ | OTHER_PLATFORMS[platform],
        capture_output=True,
        text=True,
        check=True,
    )
    for name, line in zip(names, done.stdout.splitlines(), strict=True):
        here = [[task.index, task.split, task.parameters] for task in draw_tasks(environment_of(name))]
        assert json.loads(line) == here, name


def numbers(value: Any) -> Iterator[float]:
    """All floats within JSON values."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list):
        for member in value.values() if isinstance(value, dict) else value:
            yield from numbers(member)


@pytest.mark.parametrize("name", NAMES)
def test_no_task_of_a_recipe_lies_where_rounding_could_tip(name: str) -> None:
    """A last digit that differs on another processor changes no parameter: none is close to half a digit."""
    environment = environment_of(name)
    drawn = environment.draw_parameters(environment.settings.tasks, environment.settings.task_seed)
    values = np.array(list(numbers(drawn)))
    for error in (-4, 4):  # in units of the last binary digit
        moved = values * (1 + error * np.finfo(np.float64).eps)
        rounded = [float(f"{value:.{PARAMETER_DIGITS}g}") for value in moved]
        assert rounded == list(numbers(list(parameters_of(name))))


@given(st.integers(2, 20), st.integers(1, 10))
def test_spread_keeps_splits_apart_and_takes_the_ends(num_train: int, num_test: int) -> None:
    tasks = [Task(index, "test" if index % 5 == 2 else "train", {}) for index in range(60)]
    chosen = spread(tasks, num_train=num_train, num_test=num_test)
    splits = [tasks[index].split for index in chosen]
    assert len(set(chosen)) == len(chosen) == num_train + num_test
    assert splits.count("train") == num_train
    assert {0, 59} <= set(chosen)


@given(st.integers(1, 48), st.integers(1, 12))
def test_spread_on_a_circle_takes_no_two_neighbors(num_train: int, num_test: int) -> None:
    tasks = [Task(index, "test" if index % 5 == 2 else "train", {}) for index in range(60)]
    chosen = spread(tasks, num_train=num_train, num_test=num_test, is_circular=True)
    for split, number, size in (("train", num_train, 48), ("test", num_test, 12)):
        members = [task.index for task in tasks if task.split == split]
        places = [members.index(index) for index in chosen if tasks[index].split == split]
        gaps = [after - before for before, after in pairwise([*places, places[0] + size])]
        assert len(places) == number
        assert max(gaps) - min(gaps) <= 1


def test_small_profiles_of_the_circle_point_to_all_sides() -> None:
    for name in ("ant-dir", "ant-goal"):
        tasks = choose_tasks(load_recipe(name, profile="quick"))
        tested = [task.index for task in tasks if task.split == "test"]
        assert tested == [2, 22]  # opposite ones of 40


def test_asking_for_more_tasks_than_there_are() -> None:
    with pytest.raises(TaskError, match="3 test tasks asked for, the task set has 1"):
        spread([Task(0, "train", {}), Task(1, "test", {})], num_train=1, num_test=3)


def test_indices_mean_the_same_task_in_every_profile() -> None:
    full = choose_tasks(load_recipe("point-robot"))
    quick = choose_tasks(load_recipe("point-robot", profile="quick"))
    assert len(full) == 100
    assert all(full[task.index] == task for task in quick)
    assert choose_tasks(load_recipe("point-robot", profile="quick"), [12, 5]) == [full[5], full[12]]


def test_parameters_follow_the_task_seed_alone() -> None:
    first, other = (
        choose_tasks(load_recipe("point-robot-wind", overrides=[f"environment.task_seed={seed}"]), [0])
        for seed in (1337, 7)
    )
    assert first[0].parameters["wind"] == pytest.approx([-0.02380, 0.03360], abs=1e-5)  # as published
    assert other[0].parameters != first[0].parameters


@pytest.mark.parametrize(("text", "expected"), [("0-3,9", [0, 1, 2, 3, 9]), ("7", [7]), ("2, 1,2", [1, 2])])
def test_index_lists(text: str, expected: list[int]) -> None:
    assert parse_indices(text, 10) == expected


@pytest.mark.parametrize("text", ["", "a", "3-", "-3", "5-2", "10", "0-10", "1.5", "²"])
def test_bad_index_lists_are_named(text: str) -> None:
    with pytest.raises(TaskError, match="--tasks"):
        parse_indices(text, 10)
