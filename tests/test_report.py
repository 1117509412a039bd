"""Reports: verdicts, contexts, attention, tables, and `tcmrl report` on real small runs."""

import csv
import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.train import tcmrl

from tcmrl_algo import WrittenReport, write_report
from tcmrl_algo.experiment.results import RunResult, read_result
from tcmrl_algo.report.contexts import (
    Stored,
    TrainedContexts,
    centroid_accuracy,
    distance_ratio,
)
from tcmrl_algo.report.figures import draw_embeddings
from tcmrl_algo.report.tables import (
    Table,
    across_seeds,
    attention_table,
    final_table,
)
from tcmrl_data import Dataset
from tests.commands import Call, assert_refused

PROGRAM = tcmrl

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def report(small_results: Path, tmp_path_factory: pytest.TempPathFactory) -> WrittenReport:
    return write_report([small_results], tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def trained(small_results: Path) -> RunResult:
    """The finished run of TCMRL."""
    return read_result(small_results / "runs/point-robot--tcmrl--seed0")


def test_contexts_within_a_task_over_contexts_between_tasks() -> None:
    contexts = np.array([[0.0, 0.0], [0.0, 1.0], [3.0, 0.0], [3.0, 1.0]])
    between = (3.0 + math.sqrt(10.0)) / 2
    assert distance_ratio(contexts, np.array([0, 0, 1, 1])) == pytest.approx(1.0 / between)
    assert distance_ratio(contexts, np.array([0, 0, 0, 0])) is None
    assert distance_ratio(np.zeros((4, 2)), np.array([0, 0, 1, 1])) is None


def test_a_context_is_not_counted_into_the_centroid_that_it_is_compared_with() -> None:
    """Of 4, the nearest mean is 7; if it counted into its own task's, that would be 2, which is nearer."""
    contexts, labels = np.array([[0.0], [4.0], [7.0], [7.0]]), np.array([0, 0, 1, 1])
    assert centroid_accuracy(contexts, labels) == pytest.approx(3 / 4)
    assert centroid_accuracy(contexts[:3], labels[:3]) is None


def test_methods_may_have_different_numbers_of_contexts(tmp_path: Path) -> None:
    points = {"few": np.zeros((2, 2), dtype=np.float32), "many": np.ones((4, 2), dtype=np.float32)}
    labels = {"few": np.array([0, 1]), "many": np.array([0, 0, 1, 1])}
    draw_embeddings(tmp_path / "contexts.png", points, labels, [False, True])
    assert (tmp_path / "contexts.png").read_bytes().startswith(PNG)


@pytest.mark.check
def test_attention_is_relative_and_makes_the_context(trained: RunResult, tiny: Dataset) -> None:
    stored = Stored(tiny, "all")
    assert stored.labels.shape == (len(stored.lanes),)
    found = TrainedContexts(trained, stored)
    weights = found.weights
    assert weights is not None
    assert np.mean(weights.by_step) == pytest.approx(1.0, abs=1e-5)
    assert weights.example.sum() == pytest.approx(len(weights.example), abs=1e-4)
    assert (len(weights.zero), len(weights.nonzero)) == (0, 0)  # no dense reward is zero
    measured = trained.model_copy(update={"contexts": found.measures()})
    assert measured.contexts is not None and measured.contexts.tasks == len(stored.tasks)
    assert attention_table("a", [measured]) is None
    assert found.contexts is not None and found.contexts.shape == (len(stored.lanes), 4)


@pytest.mark.check
def test_weights_of_rewarded_transitions_are_told_apart(trained: RunResult, tiny: Dataset) -> None:
    stored = Stored(tiny, "all")
    trajectory = stored.trajectories[0][0]
    rewards = np.zeros(len(trajectory), dtype=np.float32)
    rewards[3] = 1.0
    stored.tasks = stored.tasks[:2]
    stored.trajectories = [[replace(trajectory, rewards=rewards)], [trajectory]]
    found = TrainedContexts(trained, stored)
    weights = found.weights
    assert weights is not None
    assert (len(weights.zero), len(weights.nonzero)) == (len(trajectory) - 1, 1)
    total = weights.zero.sum() + weights.nonzero.sum()
    assert total == pytest.approx(len(trajectory), abs=1e-4)
    measured = trained.model_copy(update={"contexts": found.measures()})
    table = attention_table("a", [measured])
    assert table is not None
    assert [row[1] for row in table.rows] == ["nonzero reward", "zero reward"]


def test_intervals_need_five_seeds() -> None:
    assert across_seeds([1.0, 2.0]) == (1.5, 1.5, "seeds: 1, 2")
    mean, iqm, spread = across_seeds([1.0, 1.0, 1.0, 1.0, 6.0])
    assert (mean, iqm) == (2.0, 1.0)
    assert spread == "-0.7764 to 4.776"
    assert across_seeds([1.0, None]) == (None, None, None)


def test_tables_are_markdown_and_csv() -> None:
    table = Table("t", ("a|b", "c"), (("x|y", 1.23456), (None, 12345.6)))
    assert table.markdown().splitlines() == [
        "| a\\|b | c |",
        "| :--- | ---: |",
        "| x\\|y | 1.235 |",
        "| – | 12,346 |",
    ]
    assert list(csv.reader(table.csv().splitlines())) == [["a|b", "c"], ["x|y", "1.23456"], ["", "12345.6"]]


def test_a_report_holds_every_section_and_every_file_it_names(
    report: WrittenReport, small_results: Path
) -> None:
    text = report.report.read_text()
    for heading in ("Verdicts", "Learning curves", "Time and memory", "Contexts", "Attention"):
        assert f"# {heading}" in text
    assert set(re.findall(r"\]\((.+?\.png)\)", text)) == {
        file.name for file in report.files if file.suffix == ".png"
    }
    assert {file for file in report.report.parent.rglob("*") if file.is_file()} == set(report.files)
    for file in report.files:
        assert file.stat().st_size > 0
        if file.suffix == ".png":
            assert file.read_bytes().startswith(PNG)
    runs = [read_result(small_results / f"runs/point-robot--tcmrl--seed{seed}") for seed in (0, 1)]
    assert runs[0].root in text
    (digests,) = (file for file in report.files if file.name.endswith("-digests.csv"))
    assert digests.name in text and runs[0].digest in digests.read_text()
    table = final_table("x", runs)
    assert f"{table.rows[0][3]:.4g}" in text
    assert [verdict.verdict for verdict in report.verdicts] == ["cannot tell"] * 3
    assert [verdict.protocol for verdict in report.verdicts] == ["offline", "paper", None]


def test_dataset_returns_are_those_of_its_parts(report: WrittenReport, tiny: Dataset) -> None:
    (file,) = (path for path in report.files if path.name.endswith("-dataset.csv"))
    rows = {row["snapshot"]: row for row in csv.DictReader(file.read_text().splitlines())}
    means = [tiny.part(task.index, 150).statistics.mean for task in tiny.train_tasks]
    assert float(rows["150"]["training tasks"]) == pytest.approx(np.mean(means))
    assert list(rows) == ["0", "100", "150", "all"]


@pytest.fixture
def copy(small_results: Path, tmp_path: Path) -> Path:
    """The results without the runs' checkpoints."""
    copy = tmp_path / "copy"
    (copy / "runs").mkdir(parents=True)
    shutil.copy(small_results / "experiment.json", copy)
    for file in small_results.glob("runs/*.json"):
        shutil.copy(file, copy / "runs")
    return copy


def test_claims_of_several_experiments_stand_together_first(copy: Path, tmp_path: Path) -> None:
    written = write_report([copy, copy], tmp_path / "both")
    rows = list(csv.DictReader((tmp_path / "both/claims.csv").read_text().splitlines()))
    assert [row["claim"] for row in rows] == [verdict.claim for verdict in written.verdicts]
    assert {row["experiment"] for row in rows} == {"small", "small-1"}
    headings = re.findall(r"^## (.+)$", written.report.read_text(), re.MULTILINE)
    assert headings[:2] == ["Verdicts", "How to read the numbers"] and len(headings) == 4


def test_a_report_without_checkpoints_says_what_is_left_out(copy: Path, call: Call) -> None:
    code, output, _ = call("report", copy)
    assert code == 0
    assert "cannot tell: TCMRL ends higher (point-robot, offline)" in output
    text = (copy / "report/report.md").read_text()
    assert "are omitted: " in text and "is no run" in text and "Time and memory" in text


@pytest.mark.check
def test_a_report_names_the_runs_that_are_missing_and_why(copy: Path) -> None:
    lost = copy / "runs/point-robot--no-context--seed0"
    lost.with_name(f"{lost.name}.json").unlink()
    lost.mkdir()
    (lost / "error.txt").write_text("loss/critic is not finite at step 7\n")
    report = write_report([copy], copy / "report")
    text = report.report.read_text()
    assert f"1 of its runs: `{lost.name}` (loss/critic is not finite at step 7)" in text
    assert [verdict.pairs for verdict in report.verdicts] == [((1, None),), ((1, None),), ()]


def test_what_is_no_run_is_refused(small_results: Path, tmp_path: Path, call: Call) -> None:
    assert_refused(call("report", tmp_path), "experiment.json")
    shutil.copy(small_results / "experiment.json", tmp_path)
    assert_refused(call("report", tmp_path), "no finished run")
    (tmp_path / "experiment.json").write_text("{")
    assert_refused(call("report", tmp_path), "experiment.json")


@pytest.mark.check
def test_a_moved_dataset_is_named_with_an_option(
    small_results: Path, tiny_copy: Callable[[], Path], tmp_path: Path, call: Call
) -> None:
    copied, moved = tmp_path / "results", tiny_copy()
    shutil.copytree(small_results, copied)
    for file in copied.glob("runs/*.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"dataset": str(tmp_path / "gone")}))
    assert call("report", copied, "--quiet")[0] == 0
    assert (
        "gone does not exist; name the dataset's present folder" in (copied / "report/report.md").read_text()
    )
    assert call("report", copied, "--dataset", moved, "--quiet")[0] == 0
    assert "are omitted" not in (copied / "report/report.md").read_text()
    other = tmp_path / "other"
    (other / "runs").mkdir(parents=True)
    shutil.copy(copied / "experiment.json", other)
    for file in copied.glob("runs/*.json"):
        document = json.loads(file.read_text()) | {"root": "0" * 64}
        (other / "runs" / file.name).write_text(json.dumps(document))
    assert_refused(call("report", other, "--dataset", moved), str(moved), "no run")
