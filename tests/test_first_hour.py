"""What users stumbled over in their first hour: messages that name the cause, and numbers that are true."""

import itertools
import json
import os
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from matplotlib.figure import Figure
from tcmrl_cli import making
from tcmrl_cli.frame import footnotes
from tcmrl_cli.train import tcmrl
from torch import Generator, Tensor

import tcmrl_data
from tcmrl_algo import ContextAlgorithm, resume_run, train_run
from tcmrl_algo.algorithms.core.context import ContextLearner, ContextLosses
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.evaluation.evaluate import draw_paths
from tcmrl_data import Batch, BuildReport, Dataset, Steps, list_datasets, open_dataset
from tcmrl_data.foundation.disk import disk, named_errors
from tcmrl_data.foundation.errors import BuildError, SelectionError, StorageError, TrainingError
from tests.commands import Call, assert_refused, in_process
from tests.graded import graded_dataset, graded_recipe
from tests.small_training import config_of
from tests.terminal import as_in_terminal
from tests.test_algorithms import Made

Copy = Callable[[], Path]


@pytest.fixture(scope="module")
def graded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return graded_dataset(tmp_path_factory.mktemp("graded") / "my data", tasks=range(7))


def test_next_commands_can_be_copied_where_a_path_has_spaces(graded: Dataset, call: Call) -> None:
    _, _, errors = call("show", graded.folder)
    commands = [shlex.split(line.removeprefix("Next: ")) for line in errors.splitlines()]
    assert [words[-1] for words in commands] == [str(graded.folder)] * 3


def test_footnotes_are_as_wide_as_the_terminal() -> None:
    @click.command()
    def show() -> None:
        footnotes("a note of words " * 10, "another")

    lines = as_in_terminal(show, columns=40).errors.splitlines()
    assert len(lines) > 4 and max(map(len, lines)) <= 40
    assert lines[-1] == "another"


def test_folds_do_not_look_alike_in_a_list_of_datasets(graded: Dataset, call: Call, tmp_path: Path) -> None:
    call("derive", graded.folder, "--folds", 2, "--view", tmp_path / "folds", "--quiet")
    call("derive", graded.folder, "--tier", "expert", "--label", "best", "--out", tmp_path / "b", "--quiet")
    rows = list_datasets(tmp_path)
    assert [(row["label"], row["derived"]) for row in rows] == [
        ("best", "subset"),
        (None, "fold 0 of 2"),
        (None, "fold 1 of 2"),
    ]
    printed = call("list", tmp_path)[1]
    assert "best, point-robot" in printed and "fold 1 of 2, view of" in printed


def test_derived_episodes_have_their_own_size(graded: Dataset, call: Call, tmp_path: Path) -> None:
    command = ("derive", graded.folder, "--episodes", 1, "--out", tmp_path / "few", "--json", "--quiet")
    (row,) = json.loads(call(*command)[1])["datasets"]
    archives = sum(file.stat().st_size for file in (tmp_path / "few").rglob("*.zip"))
    assert row["bytes"] == archives
    assert " at most, derived" in call(*command[:4], "--out", tmp_path / "x", "--dry-run")[1]


def test_a_report_and_a_plot_refuse_a_folder_that_is_not_there(
    graded: Dataset, call: Call, tmp_path: Path
) -> None:
    page, picture = tmp_path / "nope" / "x.html", tmp_path / "nope" / "x.png"
    assert_refused(call("report", graded.folder, "--out", page, "--quiet"), "nope", "does not exist")
    assert_refused(call("inspect", "returns", graded.folder, "--plot", picture), "nope")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "expected"), [("FOCAL", "focal"), ("Tcmrl", "tcmrl"), ("zzz", "tcmrl, unicorn")]
)
def test_a_method_in_capitals_is_recognised_and_all_are_listed(
    graded: Dataset, capsys: pytest.CaptureFixture[str], name: str, expected: str
) -> None:
    call = in_process(tcmrl, capsys)
    assert_refused(call("train", graded.folder, "--algo", name), f"unknown algorithm {name!r}", expected)


def test_training_on_a_run_says_that_it_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.json").touch()
    assert_refused(in_process(tcmrl, capsys)("train", tmp_path), "is a run, not a dataset", "--resume")


def test_an_interrupted_run_is_evaluated_with_a_remark(
    tiny: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for steps, folder in ((5, "part"), (None, "whole")):
        config = config_of(tiny, "run.steps=5", "run.episodes=2", "run.final_episodes=1")
        train_run(tiny, tmp_path / folder, config=config, profile="quick", steps=steps)
    file = tmp_path / "part" / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"steps": 9}))
    call = in_process(tcmrl, capsys)
    remark = "This run was interrupted: it has 5 of 9 steps."
    for folder, is_said in (("part", True), ("whole", False)):
        picture = tmp_path / f"{folder}.png"
        code, _, errors = call("evaluate", tmp_path / folder, "--protocol", "offline", "--plot", picture)
        assert (code, remark in errors) == (0, is_said), errors
        assert f"picture written to {picture}" in errors.replace("\n", "") and picture.exists()


def test_a_finished_run_says_so_instead_of_going_on(tiny: Dataset, tmp_path: Path) -> None:
    config, said = config_of(tiny, "run.steps=5"), list[str]()
    first = train_run(tiny, tmp_path / "run", config=config, profile="quick")
    assert resume_run(tmp_path / "run", tiny, say=said.append).digest == first.digest
    assert len(said) == 1 and "has all of its 5 steps" in said[0] and "--out" in said[0]


class OtherSize(ContextLearner):
    """A mistake that is easily made: the context's size is not the one that is declared."""

    def __init__(self, learner: ContextLearner) -> None:
        super().__init__()
        self.learner, self.latent = learner, learner.latent + 1

    def losses(self, batch: Batch, step: int, generator: Generator) -> ContextLosses:
        return self.learner.losses(batch, step, generator)

    def context(self, steps: Steps) -> Tensor:
        return self.learner.context(steps)


def test_contexts_of_a_wrong_shape_are_named_with_what_is_expected() -> None:
    made = Made("focal")
    assert isinstance(made.algorithm, ContextAlgorithm)
    made.algorithm.learner = OtherSize(made.algorithm.learner)
    tasks, latent = len(made.batch(1).task_indices), made.algorithm.learner.latent
    expected = f"OtherSize.losses returned contexts of shape {(tasks, latent - 1)}; one per task is "
    with pytest.raises(TrainingError, match=re.escape(expected + f"{(tasks, latent)}")):
        made.train(1, 1)


def test_a_build_that_made_nothing_has_no_root(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = BuildReport(
        tmp_path, built=0, present=0, failed=("no",), seconds=1.0, root="e3b0" * 16, read_only=False
    )
    monkeypatch.setattr(tcmrl_data, "build_dataset", lambda *_, **__: report)
    code, output, _ = call("build", "point-robot", "--out", tmp_path / "d", "--quiet")
    assert (code, "; root" in output) == (1, False)
    monkeypatch.setattr(tcmrl_data, "build_dataset", lambda *_, **__: replace(report, built=1))
    assert "; root e3b0" in call("build", "point-robot", "--out", tmp_path / "d", "--quiet")[1]


@pytest.mark.parametrize(
    ("recipe", "expected"),
    [
        (lambda: tcmrl_data.load_recipe("point-robot", profile="paper"), "profile quick, not paper"),
        (
            lambda: tcmrl_data.load_recipe("point-robot-wind", profile="quick"),
            "environment point-robot, not point-robot-wind",
        ),
        (lambda: graded_recipe("rollouts.episodes=9"), "rollouts.episodes is"),
    ],
)
def test_another_profile_or_environment_is_named_before_single_values(
    graded: Dataset, recipe: Callable[[], tcmrl_data.Recipe], expected: str
) -> None:
    with pytest.raises(BuildError, match=expected):
        tcmrl_data.build_dataset(recipe(), graded.folder)


def test_a_plan_on_a_busy_machine_says_so(
    call: Call, monkeypatch: pytest.MonkeyPatch, in_process: None
) -> None:
    monkeypatch.setattr("tcmrl_data.building.forecast.UPDATE_SECONDS", 0.1)
    command = ("build", "point-robot", "--plan", "--tasks", "0", "--profile", "quick")
    for load, is_said in ((making.available_cores() * 3.0, True), (0.0, False)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        code, _, errors = call(*command)
        assert (code, "This machine is busy" in errors) == (0, is_said)


@pytest.mark.parametrize(
    ("number", "expected"),
    [(13, "give yourself the right"), (30, "give yourself the right"), (28, "make room on the disk")],
)
def test_a_refused_write_has_the_remedy_of_its_reason(number: int, expected: str) -> None:
    with pytest.raises(StorageError, match=expected), named_errors(Path("file")):
        raise OSError(number, "refused")


def test_wrong_tasks_and_splits_are_named_and_a_dataset_says_what_it_is(graded: Dataset) -> None:
    with pytest.raises(SelectionError, match="task 99 is not selected; selected are 0, 1"):
        graded.select(snapshots="last").trajectories(99)
    with pytest.raises(SelectionError, match="split 'tets' is unknown; expected 'train' or 'test'"):
        graded.select(split="tets")  # type: ignore[arg-type]
    assert repr(graded) == f"<Dataset '{graded.folder}': point-robot, 7 tasks, 35 parts>"
    assert repr(open_dataset(graded.folder)) == repr(graded)


def test_folds_are_told_apart_by_their_test_tasks(graded: Dataset, call: Call, tmp_path: Path) -> None:
    printed = call("derive", graded.folder, "--folds", 2, "--view", tmp_path / "folds", "--quiet")[1]
    tests = re.findall(r"7 tasks \(test ([0-9,-]+)\)", printed)
    assert len(set(tests)) == 2, printed


@pytest.mark.parametrize("form", ["readme", "bibtex"])
def test_a_card_names_its_file_and_makes_no_folder(
    graded: Dataset, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    command = ("card", graded.folder, "--format", form, "--out")
    assert_refused(call(*command, tmp_path / "nope" / "card"), "nope does not exist")
    assert list(tmp_path.iterdir()) == []

    def refuse(path: Path, data: bytes) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(disk, "write", refuse)
    monkeypatch.setattr(Path, "write_text", lambda path, *_, **__: refuse(path, b""))
    code, _, errors = call(*command, tmp_path / "card")
    assert (code, f"{tmp_path / 'card'}: Permission denied" in errors) == (2, True), errors


def test_a_report_shows_progress_until_its_last_figure(graded: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("plotly", reason="plotly is not installed: pip install 'tcmrl[report]'")
    seen: dict[str, list[tuple[int, int]]] = {}
    tcmrl_data.report_dataset(
        graded,
        tmp_path / "page.html",
        progress=lambda stage, done, total: seen.setdefault(stage, []).append((done, total)),
    )
    assert list(seen) == ["reading", "drawing"]
    total = len(seen["drawing"])
    assert seen["drawing"] == [(done, total) for done in range(1, total + 1)]
    assert (tmp_path / "page.html").read_text().count("<figure") == total


@pytest.mark.parametrize("measure", ["rewards", "coverage"])
def test_nothing_in_a_picture_touches_the_next_axes(
    graded: Dataset, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, measure: str
) -> None:
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    assert call("inspect", measure, graded.folder, "--plot", tmp_path / "x.png", "--quiet")[0] == 0
    (figure,) = figures
    figure.draw_without_rendering()
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    gaps = [max(b.x0 - a.x1, a.x0 - b.x1) for a, b in itertools.combinations(boxes, 2)]
    assert all(gap > 5 for gap in gaps), gaps
    assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 for box in boxes)


@pytest.mark.parametrize("end", [0.0, 0.02, 0.1])
def test_titles_of_paths_do_not_touch(
    graded: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: float
) -> None:
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    (episode, *_) = graded.trajectories(0, graded.parts.keys_of(0)[-1].step)
    path = replace(episode, observations=np.linspace((0.0, -end), (1.0, 1.0), len(episode.observations)))
    episodes = {task.index: [path] for task in graded.test_tasks}
    draw_paths(tmp_path / "x.png", graded, RunSettings(), episodes, episodes)
    (figure,) = figures
    figure.draw_without_rendering()
    assert figure.texts[0].get_window_extent().y0 > max(axes.get_tightbbox().y1 for axes in figure.axes)
    assert min(axes.get_tightbbox().y0 for axes in figure.axes) > 0
