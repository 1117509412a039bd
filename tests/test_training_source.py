"""Sources of a method's own settings: the dataset's manifest, the installed recipe, its defaults."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from tcmrl_cli.train import tcmrl

from tcmrl_algo import open_run, resolve_for
from tcmrl_data import load_recipe, open_dataset
from tcmrl_data.foundation.records import sealed
from tests.commands import Call

PROGRAM = tcmrl

STEPS = "run.steps=2"


@pytest.fixture
def older(tiny_copy: Callable[[], Path]) -> Path:
    """A dataset that was built before FOCAL existed."""
    file = tiny_copy() / "manifest.json"
    fields = json.loads(file.read_text())
    del fields["digest"]
    for table in fields["runs"][0]["recipe"]["training"].values():
        del table["focal"]
    file.write_bytes(sealed(fields))
    return file.parent


def test_the_manifests_own_table_comes_first(tiny_folder: Path, older: Path) -> None:
    dataset = open_dataset(tiny_folder)
    config = resolve_for(dataset, profile="quick", algorithm="focal")
    assert config.training_source == "table"
    own = dataset.manifest.training["quick"]["focal"]
    assert {key: config.method[key] for key in own} == json.loads(json.dumps(own))
    assert resolve_for(open_dataset(older), profile="quick", algorithm="tcmrl").training_source == "table"


def test_a_method_newer_than_the_dataset_gets_the_installed_recipes_values(older: Path, call: Call) -> None:
    expected = load_recipe("point-robot").training["quick"]["focal"]
    out = older.parent / "run"
    code, _, errors = call("train", older, "--algo", "focal", "--set", STEPS, "--out", out)
    assert code == 0, errors
    assert "holds no [training.focal] table; its values are the installed recipe's" in errors
    config = open_run(out).record.config
    assert config.training_source == "recipe"
    assert json.loads((out / "run.json").read_text())["config"]["training_source"] == "recipe"
    assert {key: config.method[key] for key in expected} == json.loads(json.dumps(expected))


def test_such_a_run_goes_on_with_the_settings_that_began_it(older: Path, call: Call) -> None:
    arguments = ("train", older, "--algo", "focal", "--set", STEPS, "--out", older.parent / "run")
    assert call(*arguments, "--stop-at", "1")[0] == 0
    code, _, errors = call(*arguments, "--resume", "--stop-at", "2")
    assert code == 0, errors


def test_a_method_that_no_recipe_knows_gets_its_defaults(
    tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    out = tmp_path / "run"
    code, _, errors = call(
        "train", tiny_folder, "--algo", "double_stages", "--set", "run.steps=8", "--out", out
    )
    assert code == 0, errors
    assert "holds no [training.double_stages] table; its values are the method's defaults" in errors
    assert open_run(out).record.config.training_source == "defaults"


@pytest.mark.parametrize("algorithm", ["tcmrl", "no_context"])
def test_nothing_is_said_where_the_dataset_holds_the_values_or_there_are_none(
    tiny_folder: Path, tmp_path: Path, call: Call, algorithm: str
) -> None:
    code, _, errors = call(
        "train", tiny_folder, "--algo", algorithm, "--set", STEPS, "--out", tmp_path / "run"
    )
    assert code == 0
    assert "holds no" not in errors
