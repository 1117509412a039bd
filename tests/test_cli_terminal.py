"""Tables in a terminal of 80 columns and in a pipe: complete numbers, and lines within the width."""

import contextlib
import io
import json
import re
import shutil
from pathlib import Path

import pytest
from rich.table import Table
from tcmrl_cli.data import data
from tcmrl_cli.frame import make_table, print_table

from tcmrl_data import Dataset, recipe_values
from tests.commands import Call
from tests.terminal import as_in_terminal, assert_fits, in_terminal


@pytest.fixture(scope="module")
def shelf(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of datasets with a long name, one of them damaged."""
    folder = tmp_path_factory.mktemp("a-folder-of-datasets-whose-name-is-long")
    shutil.copytree(tiny_folder, folder / "point-robot-with-a-long-name")
    damaged = folder / "damaged"
    shutil.copytree(tiny_folder, damaged)
    (damaged / "manifest.json").write_text("{")
    return folder


def test_the_list_of_datasets_fits_a_terminal_with_root_and_state_whole(shelf: Path, tiny: Dataset) -> None:
    shown = in_terminal("tcmrl-data", "list", shelf)
    assert_fits(shown.output)
    assert tiny.manifest.root[:12] in shown.output
    assert "complete" in shown.output
    assert "unreadable" in "".join(shown.output.split())
    lines = shown.output.splitlines()
    width = next(line.index("contents") for line in lines if "contents" in line)
    assert "point-robot-with-a-long-name" in "".join(line[:width].strip() for line in lines)


@pytest.mark.parametrize(
    "command",
    [
        ("envs",),
        ("build", "point-robot", "--recipe", "--profile", "quick"),
        ("build", "walker-rand-params", "--recipe"),
        pytest.param(("build", "--plan", "half-cheetah-vel", "--profile", "quick"), marks=pytest.mark.check),
        ("inspect", "returns", "DATASET"),
        ("inspect", "tasks", "DATASET"),
        ("inspect", "snapshots", "DATASET"),
        ("inspect", "episodes", "DATASET", "--task", "40"),
        ("show", "DATASET"),
        ("verify", "DATASET"),
        ("verify", "DATASET", "--clean"),
        ("cache", "list"),
    ],
    ids=" ".join,
)
def test_every_table_fits_a_terminal_and_says_what_it_says_in_a_pipe(
    command: tuple[str, ...],
    tiny_folder: Path,
    call: Call,
    in_process: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tcmrl_data.building.forecast.UPDATE_SECONDS", 0.1)  # of what `plan` measures
    arguments = [str(tiny_folder) if word == "DATASET" else word for word in command]
    shown = as_in_terminal(data, *arguments)
    assert shown.code == 0
    if command[0] != "verify":  # their one line holds the dataset's path
        assert_fits(shown.output)
    piped = call(*arguments)[1]
    assert all(line == line.rstrip() for line in piped.splitlines())
    if command[0] in ("envs", "build", "inspect") and "--plan" not in command:
        assert sorted(numbers(shown.output)) == sorted(numbers(piped))


def numbers(text: str) -> list[str]:
    return re.findall(r"-?[\d,]*\d(?:\.\d+)?", text)


def test_a_title_longer_than_its_table_stays_on_one_line() -> None:
    table = make_table("a title of more words than the table is wide", columns=["a"])
    table.add_row("1")
    assert render(table).splitlines()[0] == "a title of more words than the table is wide"


def render(table: Table) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as stream:
        print_table(table)
    return stream.getvalue()


def test_keys_values_and_sources_of_a_recipe_are_whole_in_a_terminal() -> None:
    shown = as_in_terminal(data, "build", "ml1/box-close", "--recipe", "--set", "rollouts.lanes=25")
    assert shown.code == 0
    assert_fits(shown.output)
    lines = shown.output.splitlines()
    head = next(line for line in lines if line.split() == ["key", "value", "source"])
    value, source = head.index("value"), head.index("source")
    rows: list[list[str]] = []
    for line in lines[lines.index(head) + 2 :]:
        cells = [cell.strip() for cell in (line[:value], line[value:source], line[source:])]
        if cells[0]:
            rows.append(cells)
        else:
            rows[-1] = [" ".join(filter(None, pair)) for pair in zip(rows[-1], cells, strict=True)]
    expected = recipe_values("ml1/box-close", overrides=["rollouts.lanes=25"]).values
    assert [row[0] for row in rows] == [one.key for one in expected]
    found = {row[0]: row[1:] for row in rows}
    for one in expected:
        assert found[one.key][1] == one.source
        if isinstance(one.value, list | float | int):
            assert json.loads(found[one.key][0]) == one.value
