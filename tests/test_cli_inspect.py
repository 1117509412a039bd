"""`tcmrl-data inspect`: descriptions of a dataset as tables, JSON and pictures."""

import itertools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.data import data

from tcmrl_data import Dataset, open_dataset
from tcmrl_data.store.manifest import Totals
from tcmrl_data.verification.repair import write_tables
from tests.commands import Call, assert_refused
from tests.conftest import TASKS
from tests.terminal import as_in_terminal, assert_fits

Copy = Callable[[], Path]
MAIN = "from tcmrl_cli.data import main; main()"


def test_show_puts_a_dataset_on_one_screen(call: Call, tiny: Dataset) -> None:
    document = json.loads(call("show", tiny.folder, "--json")[1])
    counts = {key: document[key] for key in ("tasks", "train", "test", "parts", "parts_total", "episodes")}
    assert counts == {"tasks": 5, "train": 4, "test": 1, "parts": 15, "parts_total": 15, "episodes": 90}
    assert (document["steps"], document["snapshots"]) == (90 * 20, [0, 100, 150])
    assert (document["root"], document["complete"]) == (tiny.manifest.root, True)
    assert document["bytes"] == sum(file.stat().st_size for file in tiny.folder.glob("parts/*/*/*.zip"))
    assert "torch" in document["made_with"]["packages"][0]
    shown = as_in_terminal(data, "show", tiny.folder)
    assert_fits(shown.output)
    assert len(shown.output.splitlines()) < 40
    assert "profile quick" in shown.output and "A point walks" in shown.output
    assert "tcmrl train" in shown.errors


def test_show_of_an_incomplete_dataset_says_what_goes_on(call: Call, tiny_copy: Copy) -> None:
    folder = tiny_copy()
    forget_parts(folder, task=40)
    code, output, errors = call("show", folder)
    assert code == 0
    assert "12 of 15: incomplete" in output
    assert "tcmrl-data build point-robot" in errors


def test_inspect_returns_equals_sums_over_the_stored_rewards(call: Call, tiny: Dataset) -> None:
    code, output, _ = call("inspect", "returns", tiny.folder, "--json")
    document = json.loads(output)
    assert code == 0
    assert set(document) == {"name", "environment", "tasks"}
    assert document["environment"] == "point-robot"
    assert [task["task"] for task in document["tasks"]] == TASKS
    for task in document["tasks"]:
        assert [snapshot["step"] for snapshot in task["snapshots"]] == [0, 100, 150]
        for row in task["snapshots"]:
            arrays = tiny.arrays(task["task"], row["step"])
            offsets = arrays["episode_offsets"]
            sums = [math.fsum(arrays["rewards"][a:b]) for a, b in itertools.pairwise(offsets)]
            assert row["episodes"] == len(sums) == 6
            assert row["steps"] == offsets[-1] == 120
            np.testing.assert_allclose(row["mean"], np.mean(sums), rtol=1e-12)
            np.testing.assert_allclose([row["min"], row["max"]], [min(sums), max(sums)], rtol=1e-12)
            np.testing.assert_allclose(row["std"], np.std(sums), rtol=1e-9)
            assert row["success_rate"] is None


def test_inspect_returns_takes_the_manifest_file_and_prints_splits_apart(call: Call, tiny: Dataset) -> None:
    code, output, errors = call("inspect", "returns", tiny.folder / "manifest.json")
    assert (code, errors) == (0, "")
    rows = [line.split() for line in output.splitlines() if " train " in line or " test " in line]
    assert [row[0] for row in rows if "train" in row] == ["0", "100", "150"]
    assert [row[0] for row in rows if "test" in row] == ["test"] * 3


@pytest.mark.parametrize("ending", ["png", "svg"])
def test_plot_writes_a_picture(call: Call, tiny: Dataset, tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"returns.{ending}"
    code, _, errors = call("inspect", "returns", tiny.folder, "--plot", file)
    assert code == 0
    assert str(file) in errors
    content = file.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n" if ending == "png" else b"<svg" in content[:1000]


def test_plot_of_an_unknown_kind_writes_nothing(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    assert_refused(call("inspect", "returns", tiny.folder, "--plot", tmp_path / "returns.gif"), "gif", ".png")
    assert_refused(
        call("inspect", "returns", tiny.folder, "--plot", tmp_path / "no" / "returns.png"), "no/returns.png"
    )
    assert list(tmp_path.iterdir()) == []


def test_inspect_tasks_shows_split_parameters_and_references(call: Call, tiny: Dataset) -> None:
    rows = json.loads(call("inspect", "tasks", tiny.folder, "--json")[1])["tasks"]
    assert [row["task"] for row in rows] == TASKS
    assert [row["split"] for row in rows] == [task.split for task in tiny.tasks]
    assert rows[0]["parameters"]["goal"] == pytest.approx([1.0, 0.0])
    for row in rows:
        assert row["references"]["oracle"] > row["references"]["behavior"] > -30
        assert row["references"]["scripted"] is None
    assert "goal=[1.0, 0.0]" in call("inspect", "tasks", tiny.folder)[1]


def test_an_output_without_unicode_gets_question_marks(tiny: Dataset) -> None:
    result = subprocess.run(
        [sys.executable, "-c", MAIN, "inspect", "tasks", str(tiny.folder)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    assert "train" in result.stdout
    assert result.stderr == ""


def test_inspect_snapshots_shows_every_part(call: Call, tiny: Dataset) -> None:
    rows = json.loads(call("inspect", "snapshots", tiny.folder, "--json")[1])["snapshots"]
    assert [(row["task"], row["step"], row["id"]) for row in rows] == [
        (part.task, part.step, part.id) for part in tiny.parts.entries()
    ]
    output = call("inspect", "snapshots", tiny.folder)[1]
    assert all(part.id[:12] in output for part in tiny.parts.entries())


def test_inspect_episodes_of_one_part(call: Call, tiny: Dataset) -> None:
    selection = ("--task", 40, "--step", 100)
    rows = json.loads(call("inspect", "episodes", tiny.folder, *selection, "--json")[1])["episodes"]
    trajectories = tiny.trajectories(40, 100)
    assert [row["return"] for row in rows] == [trajectory.undiscounted_return for trajectory in trajectories]
    assert all(row["truncated"] and not row["terminated"] and row["length"] == 20 for row in rows)
    assert all(row["success"] is None for row in rows)
    assert call("inspect", "episodes", tiny.folder, *selection)[1].count("truncated") == 6
    everything = json.loads(call("inspect", "episodes", tiny.folder, "--json")[1])["episodes"]
    assert len(everything) == 5 * 3 * 6


def test_an_incomplete_dataset_can_be_inspected(call: Call, tiny_copy: Copy) -> None:
    folder = tiny_copy()
    forget_parts(folder, task=40)
    document = json.loads(call("inspect", "returns", folder, "--json")[1])
    assert [len(task["snapshots"]) for task in document["tasks"]] == [3, 3, 0, 3, 3]
    rows = json.loads(call("inspect", "tasks", folder, "--json")[1])["tasks"]
    assert rows[2]["references"] is None
    for what in ("returns", "tasks", "snapshots", "episodes"):
        assert call("inspect", what, folder)[0] == 0


def forget_parts(folder: Path, *, task: int) -> None:
    """Makes the manifest that a build leaves when it is stopped before a task's first part."""
    dataset = open_dataset(folder)
    table = dataset.parts.without_tasks([task])
    totals = Totals(
        parts=len(table),
        episodes=table.total("episodes"),
        steps=table.total("steps"),
        bytes=table.total("size"),
    )
    manifest = dataset.manifest.model_copy(update={"root": table.root, "totals": totals, "complete": False})
    platforms = dataset.manifest.platforms
    write_tables(folder, manifest, tasks=dataset.tasks, table=table, platforms=platforms)
