import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import ENVIRONMENTS, BuildReport, Dataset, Recipe
from tcmrl_data.foundation.records import sealed
from tcmrl_data.store.manifest import MANIFEST
from tests.commands import Call, assert_refused
from tests.conftest import TINY
from tests.workers import ROOT

pytestmark = pytest.mark.usefixtures("module_in_process")

Copy = Callable[[], Path]
BUILD = ("build", "point-robot", "--profile", "quick")
SETTINGS = [argument for text in TINY for argument in ("--set", text)]


def test_envs_lists_every_environment(call: Call) -> None:
    code, output, _ = call("envs", "--json")
    rows = {row["name"]: row for row in json.loads(output)["environments"]}
    assert code == 0
    assert rows["point-robot"] == {
        "name": "point-robot",
        "observation_dim": 2,
        "action_dim": 2,
        "horizon": 20,
        "tasks": 100,
        "train": 80,
        "test": 20,
    }
    assert sum(name.startswith("ml1/") for name in rows) == 50
    assert "ml1/button-press-topdown" in call("envs")[1]


def test_build_says_what_it_takes_and_a_second_build_finds_everything(call: Call, tmp_path: Path) -> None:
    command = [*BUILD, *SETTINGS, "--tasks", "0,3", "--out", tmp_path / "d"]
    code, output, errors = call(*command)
    lines = errors.splitlines()
    assert (code, lines[0]) == (0, "this build: 2 tasks, 300 steps of training, 6 parts, 16.6 kB at most")
    assert lines[1].startswith("--profile paper: 2 tasks, 300 steps of training")
    assert "6 parts built, 0 already present" in output
    code, again, errors = call(*command)
    assert (code, "--profile" in errors) == (0, False)
    assert "0 parts built, 6 already present" in again
    code, output, errors = call(*command, "--json", "--quiet")
    report = json.loads(output)
    assert (code, errors) == (0, "")
    assert (report["built"], report["present"], report["failed"]) == (0, 6, [])
    assert report["root"][:12] in again


def test_a_recipe_file_of_ones_own_builds_a_dataset_of_its_environment(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = ENVIRONMENTS.get("point-robot").recipe_file("point-robot").read_text(encoding="utf-8")
    (tmp_path / "my-recipe.toml").write_text(text.replace("gamma = 0.9 ", "gamma = 0.8 "))
    monkeypatch.chdir(tmp_path)
    command = ["build", "my-recipe.toml", "--profile", "quick", *SETTINGS, "--tasks", "0", "--json"]
    code, output, _ = call(*command, "--quiet")
    assert (code, json.loads(output)["dataset"]) == (0, "data/point-robot")
    recipe = tcmrl_data.open_dataset("data/point-robot").manifest.recipe
    assert (recipe.environment.name, recipe.behavior.settings["gamma"]) == ("point-robot", 0.8)
    assert json.loads(call(*command, "--quiet")[1])["present"] == 3
    assert_refused(call("build", "point-robot", *command[2:]), "behavior.settings.gamma is 0.8 there")


def test_a_recipe_file_that_is_none_is_refused(call: Call, tmp_path: Path) -> None:
    (tmp_path / "empty.toml").write_text("schema = 1\n")
    for options in ((), ("--plan",), ("--recipe",)):
        assert_refused(call("build", tmp_path / "nowhere.toml", *options), "nowhere.toml does not exist")
        assert_refused(call("build", tmp_path / "empty.toml", *options), "[environment] has no name")


def test_a_build_with_failing_units_ends_with_one_and_says_which(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(recipe: Recipe, out: Path, **options: object) -> BuildReport:
        failed = ("task 7 failed after 2 attempt(s) on here: killed", "task 9 failed")
        return BuildReport(
            out, built=3, present=1, failed=failed, seconds=1.0, root="0" * 64, read_only=False
        )

    monkeypatch.setattr(tcmrl_data, "build_dataset", fail)
    code, output, errors = call("build", "point-robot", "--out", tmp_path / "d", "--quiet")
    assert code == 1
    assert "3 parts built" in output
    assert len(errors.strip().splitlines()) == 1
    assert errors.startswith("Error: task 7 failed after 2 attempt(s) on here: killed (and 1 more)")


def test_list_names_datasets_and_unreadable_ones(
    call: Call, tiny: Dataset, tiny_copy: Copy, tmp_path: Path
) -> None:
    tiny_copy()
    broken = tiny_copy()
    (broken / "manifest.json").write_bytes(b"{")
    code, output, _ = call("list", tmp_path, "--json")
    rows = json.loads(output)["datasets"]
    assert code == 0
    assert [row["path"] for row in rows] == sorted(row["path"] for row in rows)
    good = [row for row in rows if "error" not in row]
    assert [(row["tasks"], row["parts"], row["complete"], row["root"]) for row in good] == [
        (5, 15, True, tiny.manifest.root)
    ]
    assert "unreadable" in call("list", tmp_path)[1]


def test_list_without_datasets_says_how_to_get_one(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert json.loads(call("list", "--json")[1]) == {"datasets": []}
    code, output, errors = call("list")
    assert (code, output) == (0, "")
    assert "tcmrl-data build" in errors
    assert_refused(call("list", tmp_path / "nothing"), "nothing", "is not a folder")


def test_export_takes_a_selection_and_only_says_what_it_would_write(
    call: Call, tiny: Dataset, tmp_path: Path
) -> None:
    arguments = ("export", tiny.folder, "--format", "robomimic", "--out", tmp_path / "out", "--quiet")
    chosen = (*arguments, "--tasks", "0,3,40,60", "--split", "train", "--tier", "expert")
    code, output, errors = call(*chosen, "--dry-run")
    assert (code, errors, list(tmp_path.iterdir())) == (0, "", [])
    assert output == f"{tmp_path}/out: 3 tasks, 3 parts, 18 episodes with 360 steps; nothing written\n"
    code, output, _ = call(*chosen, "--json")
    report = json.loads(output)
    assert (code, report["tasks"], report["episodes"], report["dry_run"]) == (0, 3, 18, False)
    assert report["files"] == [str(tmp_path / f"out/task_000{task}.hdf5") for task in ("00", "40", "60")]
    assert_refused(call(*chosen), "out exists and is not empty")
    assert_refused(call(*arguments, "--tier", "best"), "--tier", "expert")
    assert_refused(call(*arguments, "--tasks", "0,7-x"), "--tasks", "7-x")
    assert_refused(call(*arguments, "--tasks", "1"), "no task 1")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("build", "point-robt"), ["point-robt", "point-robot", "sparse-point-robot"]),
        ((*BUILD, "--set", "rolouts.episodes=3"), ["rolouts", "rollouts"]),
        ((*BUILD, "--set", "rollouts.episodes=many"), ["rollouts", "episodes", "integer", "many"]),
        ((*BUILD, "--set", "rollouts.episodes"), ["rollouts.episodes", "section.key=value"]),
        ((*BUILD, "--tasks", "0-100"), ["100", "0-99"]),
        ((*BUILD, "--tasks", "1,x"), ["'x'", "0-9"]),
        ((*BUILD, "--profile", "tiny"), ["tiny", "quick", "build --help"]),
        ((*BUILD, "--workers", "0"), ["--workers", "0"]),
        ((*BUILD, "--nothing"), ["--nothing", "build --help"]),
        (("build",), ["ENV", "build --help"]),
        (("inspect", "returns", "nowhere"), ["nowhere/manifest.json", "tcmrl-data build"]),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    call: Call,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    expected: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(call(*arguments), *expected)
    assert list(tmp_path.iterdir()) == []


def test_an_output_folder_that_is_no_dataset_is_refused(call: Call, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    assert_refused(call(*BUILD, "--out", tmp_path), str(tmp_path), "no dataset", "another folder")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_every_help_has_an_example(call: Call) -> None:
    for name, command in data.commands.items():
        within = list(command.commands) if isinstance(command, click.Group) else []
        for words in [[name, subcommand] for subcommand in within] or [[name]]:
            assert "Example" in call(*words, "--help")[1]
        assert command.help


def test_no_arguments_prints_help_and_exits_with_two(call: Call) -> None:
    code, output, errors = call()
    assert (code, output) == (2, "")
    assert "Make:" in errors


def test_a_dataset_whose_environment_is_not_installed_is_still_listed_and_inspected(
    call: Call, tiny_copy: Copy
) -> None:
    folder = tiny_copy()
    values = json.loads((folder / MANIFEST).read_bytes())
    del values["digest"]
    values["name"] = "pole"
    recipe = values["runs"][0]["recipe"]
    recipe["environment"].update(name="pole", lengths=[0.5, 1.0])
    (folder / MANIFEST).write_bytes(sealed(values))
    code, output, _ = call("list", folder.parent, "--json")
    assert (code, [row.get("name") for row in json.loads(output)["datasets"]]) == (0, ["pole"])
    for subject in ("tasks", "snapshots", "returns"):
        assert call("inspect", subject, folder)[0] == 0
    settings = tcmrl_data.open_dataset(folder).manifest.recipe.unit_settings()
    assert settings["environment"] == recipe["environment"]


def test_recipe_prints_the_values_of_a_recipe_as_json(call: Call, tmp_path: Path) -> None:
    text = ENVIRONMENTS.get("point-robot").recipe_file("point-robot").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(text)
    code, output, errors = call("build", tmp_path / "mine.toml", "--recipe", "--profile", "quick", "--json")
    document = json.loads(output)
    assert (code, errors, list(document)) == (0, "", ["environment", "profile", "values"])
    assert (document["environment"], document["profile"]) == ("point-robot", "quick")
    assert {"key": "environment.horizon", "value": 20, "source": "published code"} in document["values"]
    assert json.loads(call("build", "point-robot", "--recipe", "--profile", "quick", "--json")[1]) == document
    assert_refused(
        call("build", "point-robot", "--recipe", "--set", "rollouts.lane=1"), "rollouts.lane", "lanes"
    )


def test_a_command_without_an_output_ends_in_silence(tiny_folder: Path) -> None:
    """As `tcmrl-data show d >&-` in a shell, which leaves the number of the stream to the next open file."""
    code = "from tcmrl_cli.data import main; main()"
    command = [sys.executable, "-c", code, "show", str(tiny_folder), "--quiet"]
    shell = ["sh", "-c", 'exec "$@" >&-', "sh", *command]
    result = subprocess.run(shell, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
