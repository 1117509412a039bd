"""One contract for every behavior source; the training of a source is tested in separate files."""

import functools
import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from tcmrl_data import Recipe, load_recipe
from tcmrl_data.behavior.base import BEHAVIOR_SOURCES, BehaviorSource
from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import RecipeError
from tests.training_of_behavior import context_of

every = pytest.mark.parametrize("name", BEHAVIOR_SOURCES.names())


@functools.cache
def recipe_with(name: str) -> Recipe:
    """The quick recipe of the first environment that has a table for a source."""
    for environment in (name for family in ENVIRONMENTS.working().values() for name in family.members()[:1]):
        try:
            return load_recipe(environment, profile="quick", behavior=name)
        except RecipeError:
            continue
    raise AssertionError(f"no recipe has a table [behavior.{name}]")


def source_with(name: str) -> BehaviorSource:
    return recipe_with(name).make_source()


def first_snapshot(recipe: Recipe, folder: Path) -> tuple[int, int, str]:
    """Task, step and digest of the first snapshot of the first unit."""
    source = recipe.make_source()
    context = context_of(recipe, range(min(2, source.group_size)), folder)
    task, snapshot = next(iter(source.snapshots(context)))
    return task.index, snapshot.step, snapshot.digest()


@every
def test_a_source_says_what_a_build_plans_with(name: str) -> None:
    source, environment = source_with(name), recipe_with(name).make_environment()
    assert source.steps
    assert list(source.steps) == sorted(set(source.steps))
    assert source.training_steps >= 0
    assert source.group_size >= 1
    assert 0 <= source.training_bytes(environment, 1) <= source.training_bytes(environment, 2)
    assert json.loads(json.dumps(dict(source.provenance()))) == source.provenance()


@every
def test_the_first_snapshot_depends_on_recipe_task_and_seed_alone(name: str, tmp_path: Path) -> None:
    first = first_snapshot(recipe_with(name), tmp_path / "one")
    assert first == first_snapshot(recipe_with(name), tmp_path / "two")
    assert first[:2] == (0, source_with(name).steps[0])


@every
def test_settings_are_frozen_and_refuse_unknown_keys(name: str) -> None:
    source = source_with(name)
    kind = BEHAVIOR_SOURCES.get(name)
    assert isinstance(source.settings, kind.Settings)
    values = source.settings.model_dump(mode="json")
    assert kind.Settings.model_validate_json(json.dumps(values)) == source.settings
    with pytest.raises(ValidationError, match="colour"):
        kind.Settings.model_validate_json(json.dumps(values | {"colour": "red"}))
    with pytest.raises(ValidationError, match="frozen"):
        setattr(source.settings, next(iter(values)), 1)


def test_a_source_takes_what_its_table_leaves_out_from_the_source_that_it_extends() -> None:
    stacked, sac = source_with("stacked").settings, source_with("sac").settings
    own = {"group", "device", "matmul_precision"}
    assert BEHAVIOR_SOURCES.get("stacked").extends == "sac"
    assert stacked.model_dump(exclude=own) == sac.model_dump()
