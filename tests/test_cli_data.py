import itertools
import json
import math
import os
import pty
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import duration, size
from tcmrl_cli.progress import StageProgress

import tcmrl_data
from tcmrl_data import BuildReport, Dataset, Recipe
from tests.commands import Call, assert_refused, in_process
from tests.conftest import TASKS, TINY

Copy = Callable[[], Path]
MAIN = "from tcmrl_cli.data import main; main()"
SETTINGS = [argument for text in TINY for argument in ("--set", text)]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    return in_process(data, capsys)


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


def test_build_reports_and_a_second_build_finds_everything(call: Call, tmp_path: Path) -> None:
    command = [
        "build",
        "point-robot",
        "--profile",
        "quick",
        *SETTINGS,
        "--tasks",
        "0,3",
        "--out",
        tmp_path / "d",
    ]
    code, output, errors = call(*command, "--json", "--quiet")
    report = json.loads(output)
    assert (code, errors) == (0, "")
    assert (report["built"], report["present"], report["failed"]) == (6, 0, [])
    code, output, _ = call(*command, "--quiet")
    assert code == 0
    assert "0 parts built, 6 were there" in output
    assert report["root"][:12] in output


def test_a_build_with_failing_units_ends_with_one_and_says_which(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(recipe: Recipe, out: Path, **options: object) -> BuildReport:
        failed = ("task 7 failed after 2 attempt(s) on here: killed", "task 9 failed")
        return BuildReport(out, built=3, present=1, failed=failed, seconds=1.0, root="0" * 64)

    monkeypatch.setattr(tcmrl_data, "build_dataset", fail)
    code, output, errors = call("build", "point-robot", "--out", tmp_path / "d")
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
    assert_refused(call("list", tmp_path / "nothing"), "nothing", "is no folder")


def test_inspect_returns_equals_sums_over_the_stored_rewards(call: Call, tiny: Dataset) -> None:
    code, output, _ = call("inspect", "returns", tiny.folder, "--json")
    document = json.loads(output)
    assert code == 0
    assert set(document) == {"name", "environment", "tasks"}
    assert document["environment"] == "point-robot"
    assert [task["task"] for task in document["tasks"]] == TASKS
    for task in document["tasks"]:
        assert [each["step"] for each in task["snapshots"]] == [0, 100, 150]
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


def test_recompute_agrees_and_notices_changed_rewards(
    call: Call, tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = call("inspect", "returns", tiny.folder, "--json")[1]
    code, output, errors = call("inspect", "returns", tiny.folder, "--json", "--recompute")
    assert (code, errors) == (0, "")
    assert output == recorded

    def changed(self: Dataset, task: int, step: int) -> list[Any]:
        episodes = original(self, task, step)
        if (task, step) == (40, 100):
            episodes[0].rewards[0] += 1.0
        return episodes

    original = Dataset.trajectories
    monkeypatch.setattr(Dataset, "trajectories", changed)
    code, _, errors = call("inspect", "returns", tiny.folder, "--recompute")
    assert code == 1
    assert "task 40 at step 100: mean" in errors


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
        (part.task, part.step, part.id) for part in tiny.manifest.parts
    ]
    output = call("inspect", "snapshots", tiny.folder)[1]
    assert all(part.id[:12] in output for part in tiny.manifest.parts)


def test_inspect_episodes_of_one_part(call: Call, tiny: Dataset) -> None:
    selection = ("--task", 40, "--step", 100)
    rows = json.loads(call("inspect", "episodes", tiny.folder, *selection, "--json")[1])["episodes"]
    trajectories = tiny.trajectories(40, 100)
    assert [row["return"] for row in rows] == [each.undiscounted_return for each in trajectories]
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
    from tcmrl_data.manifest import PartEntry, merkle_root, read_manifest, seal

    manifest = read_manifest(folder)
    fields = manifest.model_dump(mode="json", exclude={"digest"})
    fields["parts"] = [part for part in fields["parts"] if part["task"] != task]
    fields["references"].pop(str(task))
    fields["root"] = merkle_root(PartEntry(**part) for part in fields["parts"])
    fields["complete"] = False
    (folder / "manifest.json").write_bytes(seal(fields))


def test_export_writes_files_and_reports_them(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    code, output, _ = call(
        "export", tiny.folder, "--format", "hdf5", "--snapshots", "last", "--out", tmp_path / "flat", "--json"
    )
    report = json.loads(output)
    assert code == 0
    assert report["files"] == [str(tmp_path / "flat" / f"task_{task:05d}.hdf5") for task in TASKS]
    assert report["bytes"] == sum(Path(file).stat().st_size for file in report["files"])


BUILD = ("build", "point-robot", "--profile", "quick")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("build", "point-robt"), ["point-robt", "point-robot", "sparse-point-robot"]),
        (("plan", "ml1/reech"), ["ml1/reech", "ml1/reach"]),
        ((*BUILD, "--set", "rollouts.episods=3"), ["episods"]),
        ((*BUILD, "--set", "rolouts.episodes=3"), ["rolouts", "rollouts"]),
        ((*BUILD, "--set", "rollouts.episodes=many"), ["rollouts", "episodes", "integer", "many"]),
        ((*BUILD, "--set", "rollouts.episodes"), ["rollouts.episodes", "section.key=value"]),
        ((*BUILD, "--tasks", "0-100"), ["100", "0-99"]),
        ((*BUILD, "--tasks", "1,x"), ["'x'", "0-9"]),
        ((*BUILD, "--behavior", "sacc"), ["sacc", "sac"]),
        ((*BUILD, "--engine", "locale"), ["locale", "local"]),
        ((*BUILD, "--profile", "tiny"), ["tiny", "quick", "build --help"]),
        ((*BUILD, "--workers", "0"), ["--workers", "0"]),
        ((*BUILD, "--nothing"), ["--nothing", "build --help"]),
        (("buid",), ["buid"]),
        (("build",), ["ENV", "build --help"]),
        (("export", "nowhere", "--format", "hdf6"), ["hdf6", "hdf5"]),
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


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:1000])


def edit(file: Path) -> None:
    file.write_bytes(file.read_bytes().replace(b'"seed":0', b'"seed":7', 1))


def age(file: Path) -> None:
    document = json.loads(file.read_bytes())
    file.write_text(json.dumps(document | {"schema_version": 99}))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (Path.unlink, "does not exist"),
        (truncate, "not a manifest"),
        (edit, "edited or damaged"),
        (age, "schema_version 99"),
    ],
)
def test_a_bad_manifest_is_refused_by_every_command(
    call: Call, tiny_copy: Copy, damage: Callable[[Path], None], expected: str
) -> None:
    folder = tiny_copy()
    manifest = folder / "manifest.json"
    damage(manifest)
    for arguments in (
        ("inspect", "returns", folder),
        ("inspect", "tasks", folder),
        ("export", folder, "--format", "hdf5"),
    ):
        assert_refused(call(*arguments), str(manifest), expected)


def test_every_help_has_an_example(call: Call) -> None:
    for name, command in data.commands.items():
        within = list(command.commands) if isinstance(command, click.Group) else []
        for words in [[name, each] for each in within] or [[name]]:
            assert "Example" in call(*words, "--help")[1]
        assert command.help


def test_no_arguments_prints_help_and_exits_with_two(call: Call) -> None:
    code, output, errors = call()
    assert (code, output) == (2, "")
    assert "Commands:" in errors


def test_plain_progress_goes_to_standard_error(tmp_path: Path) -> None:
    result = subprocess.run(
        [
            sys.executable,
            "-c",
            MAIN,
            *BUILD,
            *SETTINGS,
            "--tasks",
            "0",
            "--out",
            str(tmp_path / "d"),
            "--json",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(result.stdout)["built"] == 3
    lines = result.stderr.strip().splitlines()
    assert lines[-1].startswith("published parts: 3 of 3 parts, ")
    assert not any("\x1b" in line for line in lines)


def test_a_terminal_gets_bars() -> None:
    code = (
        "from tcmrl_cli.progress import StageProgress\n"
        "with StageProgress() as progress:\n"
        "    progress.update('training', done=5, total=10, unit='steps')\n"
        "    progress.note('half of it')\n"
        "    progress.update('training', done=10, total=10, unit='steps')\n"
    )
    driver, terminal = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    subprocess.run([sys.executable, "-c", code], stderr=terminal, check=True, env=environment)
    os.close(terminal)
    shown = os.read(driver, 65536).decode()
    os.close(driver)
    assert "training" in shown
    assert "10/10 steps" in shown
    assert "half of it" in shown
    assert "━" in shown


def test_quiet_progress_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with StageProgress(quiet=True) as progress:
        progress.update("training", done=10, total=10, unit="steps")
        progress.note("something")
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.96, "10.0 s"),
        (42, "42 s"),
        (60, "1 min 0 s"),
        (3_725, "1 h 2 min"),
        (200_000, "2 d 7 h"),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(("num_bytes", "text"), [(999, "999 B"), (1_500, "1.5 kB"), (2.5e12, "2.5 TB")])
def test_sizes(num_bytes: float, text: str) -> None:
    assert size(num_bytes) == text
