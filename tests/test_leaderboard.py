"""Leaderboards: what is ranked together, what counts once, and what they say of it."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tcmrl_cli.train import tcmrl

from tcmrl_algo import write_leaderboard
from tcmrl_algo.experiment.compact import write_compact
from tcmrl_algo.experiment.config import run_id
from tcmrl_algo.experiment.results import RunResult, Tuned, success_rate
from tcmrl_algo.reporting.boards import Board, Entry, gather
from tcmrl_algo.reporting.leaderboard import alike, leaderboard, listed_folders, ranks_table
from tcmrl_algo.reporting.scores import over_dataset
from tcmrl_algo.reporting.sections import final_table, published_table
from tcmrl_algo.reporting.sources import Source, read_sources
from tcmrl_algo.reporting.write import ignore, page_text
from tests import experiments
from tests.commands import in_process
from tests.experiments import made_result, with_setting, write_results

OTHER_ROOT = "f" * 64


def _experiment(tmp_path: Path, name: str, results: list[RunResult]) -> Path:
    labels = dict.fromkeys(result.method for result in results)
    content: dict[str, Any] = experiments.tables(tmp_path, claims=[], name=name)
    content["methods"] = {label: {"algorithm": "tcmrl"} for label in labels}
    content["seeds"] = sorted({result.seed for result in results})
    return write_results(tmp_path / name, content, results)


def _runs(
    method: str, *finals: float, algorithm: str = "tcmrl", latent: int = 8, **changes: Any
) -> list[RunResult]:
    found = [
        made_result(method, seed, final, algorithm=algorithm, **changes) for seed, final in enumerate(finals)
    ]
    return [
        run.model_copy(
            update={
                "config": run.config.model_copy(update={"method": run.config.method | {"latent": latent}})
            }
        )
        for run in found
    ]


def _sources(*folders: Path) -> list[Source]:
    return read_sources(list(folders), ignore)


def _labels(board: Board) -> list[str]:
    return [entry.label for entry in board.entries]


def test_missing_runs_are_counted_by_method_or_environment_and_failed_ones_named(tmp_path: Path) -> None:
    (source,) = _sources(_experiment(tmp_path, "one", _runs("A", 1.0)))
    runs = [("point-robot", "B", 1), ("point-robot", "B", 2), ("ml1/reach", "A", 0), ("ml1/reach", "B", 0)]
    unfinished = {run_id(*run): None for run in runs} | {run_id("point-robot", "A", 1): "diverged"}
    assert replace(source, unfinished=unfinished).missing == [
        "`point-robot--a--seed1` (diverged)",
        "2 of `point-robot--b`",
        "2 of `ml1-reach`",
    ]


def test_equal_returns_share_a_rank_and_privileged_methods_have_none() -> None:
    finals = {"A": 1.0, "B": 3.0, "C": 1.0}
    entries = [Entry(label, ("x",), tuple(_runs(label, final))) for label, final in finals.items()]
    known = Entry("task known", ("x",), tuple(_runs("task known", 9.0, privileged=True)))
    board = Board("point-robot", "0" * 64, False, (*entries, known), None)
    assert board.ranks("offline") == {"A": 2.5, "B": 1.0, "C": 2.5}
    assert board.ranks("idaq") == {}


def test_results_of_different_datasets_are_ranked_apart(tmp_path: Path) -> None:
    first = _experiment(tmp_path, "first", [*_runs("A", 1.0), *_runs("B", 2.0, latent=4)])
    second = _experiment(tmp_path, "second", _runs("A", 5.0, root=OTHER_ROOT))
    boards = gather(_sources(first, second))
    assert [(board.root, _labels(board)) for board in boards] == [("0" * 64, ["A", "B"]), (OTHER_ROOT, ["A"])]
    text = page_text(leaderboard(_sources(first, second), tmp_path))
    assert f"## point-robot, dataset {'f' * 12}" in text and "results on 1 more datasets" in text
    assert "mean rank | ranked" not in text


def test_mean_ranks_are_over_boards_that_rank_the_same_methods(tmp_path: Path) -> None:
    both = [
        _experiment(tmp_path, name, [*_runs("A", first, root=root), *_runs("B", 2.0, latent=4, root=root)])
        for name, first, root in (("low", 1.0, "1" * 64), ("high", 3.0, "2" * 64), ("higher", 4.0, "3" * 64))
    ]
    alone = _experiment(tmp_path, "alone", _runs("A", 5.0, root=OTHER_ROOT))
    boards = gather(_sources(*both, alone))
    shared, single = alike(boards)
    assert ([board.root[0] for board in shared], single) == (["1", "2", "3"], [boards[3]])
    table = ranks_table("x", shared)
    assert [row[:3] for row in table.rows] == [("A", 4 / 3, "3 of 3"), ("B", 5 / 3, "3 of 3")]
    written = write_leaderboard([*both, alone], tmp_path / "board")
    assert "Over point-robot, dataset 111111111111, point-robot, dataset 222" in written.report.read_text()
    assert (tmp_path / "board/leaderboard-ranks.csv").read_text() == table.csv()


def test_folds_are_a_board_of_their_own(tmp_path: Path) -> None:
    folds = _experiment(tmp_path, "folds", [made_result("A", 0, 1.0, fold=0)])
    boards = gather(_sources(folds, _experiment(tmp_path, "whole", _runs("A", 1.0))))
    assert [board.folds for board in boards] == [False, True]


def test_a_run_of_two_experiments_counts_once_with_the_protocols_of_both(tmp_path: Path) -> None:
    first = _experiment(tmp_path, "first", _runs("A", 1.0, 2.0))
    second = _experiment(tmp_path, "second", _runs("the same", 7.0, 2.0, 3.0, protocols=("offline", "paper")))
    (board,) = gather(_sources(first, second))
    (entry,) = board.entries
    assert (entry.label, entry.experiments) == ("A", ("first", "second"))
    assert entry.finals("offline") == [1.0, 2.0, 3.0]
    assert entry.finals("paper") == [7.0, 2.0, 3.0]


def test_one_name_with_two_settings_is_told_apart(tmp_path: Path) -> None:
    first = _experiment(tmp_path, "first", _runs("A", 1.0))
    second = _experiment(tmp_path, "second", _runs("A", 2.0, steps=80))
    (board,) = gather(_sources(first, second))
    assert _labels(board) == ["A (first)", "A (second)"]
    assert "**Not equal on this board: steps.**" in page_text(leaderboard(_sources(first, second), tmp_path))


def test_a_board_names_the_settings_in_which_its_methods_differ(tmp_path: Path) -> None:
    slow = [with_setting(run, "optimizer", learning_rate=1e-5) for run in _runs("B", 2.0)]
    first = _experiment(tmp_path, "first", [*_runs("A", 1.0), *slow])
    assert "**Not equal on this board: `optimizer.learning_rate`.**" in page_text(
        leaderboard(_sources(first), tmp_path)
    )


@pytest.fixture
def tuned() -> Tuned:
    about: dict[str, Any] = {"environment": "point-robot", "root": "a" * 64, "profile": "quick"}
    return Tuned(**about, trials=12, steps=2_000, seeds=(0,), score=0.5, overrides=())


def test_the_table_says_costs_budgets_and_tuning(tmp_path: Path, tuned: Tuned) -> None:
    focal = _runs("FOCAL", *[1.0] * 5, algorithm="focal", training_seconds=0.2)
    slow = _runs("A", 1.0, 2.0, 3.0, 4.0, 5.0, training_seconds=0.5, tuned=tuned, latent=4)
    folder = _experiment(tmp_path, "small", [*focal, *slow])
    written = write_leaderboard([folder], tmp_path / "board")
    rows = list(csv.DictReader((tmp_path / "board/leaderboard.csv").read_text().splitlines()))
    by_method = {row["method"]: row for row in rows}
    row = by_method["A"]
    assert (row["rank"], row["runs"], row["return"]) == ("1.0", "5", "3.0")
    assert (row["ms per step"], row["over FOCAL"], row["peak MB"]) == ("12.5", "2.5", "100.0")
    assert (row["tuned"], row["steps"]) == ("12 × 2000 on point-robot aaaaaaaaaaaa", "40")
    assert by_method["FOCAL"]["over FOCAL"] == "1.0" and by_method["FOCAL"]["tuned"] == ""
    assert by_method["FOCAL"]["interval covers"] == "5 seeds, 1 split, 1 test task"
    assert "**Not equal on this board: tuned.**" in written.report.read_text()
    assert {file.name for file in written.files} == {file.name for file in (tmp_path / "board").iterdir()}
    assert (tmp_path / "board/leaderboard.png").read_bytes().startswith(b"\x89PNG")


def test_committed_results_give_the_same_leaderboard(tmp_path: Path) -> None:
    full = _experiment(tmp_path, "small", _runs("A", 1.0 / 3.0, 2.0 / 3.0))
    compacted = tmp_path / "docs/small"
    compacted.mkdir(parents=True)
    (compacted / "experiment.json").write_bytes((full / "experiment.json").read_bytes())
    for source in _sources(full):
        for run in source.runs:
            name = run_id(run.result.environment, run.result.method, run.result.seed)
            write_compact(compacted, name, run.result)
    texts = [
        write_leaderboard([folder], tmp_path / "docs/board").report.read_text()
        for folder in (full, compacted)
    ]
    assert texts[0] == texts[1]
    record = tmp_path / "docs/board/leaderboard.json"
    assert json.loads(record.read_text()) == {"folders": ["../small"]}
    assert page_text(leaderboard(_sources(*listed_folders(record)), record.parent)) == texts[1]


def _with_success(run: RunResult, *shares: float | None) -> RunResult:
    evaluations = {
        protocol: evaluation | {"tasks": [evaluation["tasks"][0] | {"success": share} for share in shares]}
        for protocol, evaluation in run.evaluations.items()
    }
    return run.model_copy(update={"evaluations": evaluations})


def test_success_rates_and_returns_over_the_datasets_have_columns_where_known() -> None:
    plain, solved = made_result("A", final=6.0), _with_success(made_result("A", final=6.0), 1.0, 0.0)
    assert success_rate(plain.evaluations["offline"]) is None
    assert success_rate(_with_success(plain, 1.0, None).evaluations["offline"]) is None
    assert success_rate(solved.evaluations["offline"]) == 0.5
    assert [row["success"] for row in (*plain.rows(), *solved.rows())] == [None, 0.5]
    assert not {"success", "over dataset"} & set(final_table("x", [plain], stored=-4.0).columns)
    table = final_table("x", [solved], stored=4.0)
    (row,) = (dict(zip(table.columns, row, strict=True)) for row in table.rows)
    assert (row["success"], row["over dataset"]) == (0.5, 1.5)
    assert over_dataset({"mean_final": 1.0}, None) is None
    never = _with_success(plain, 0.0)
    assert "success" in final_table("x", [never]).columns


def test_the_leaderboard_shows_success_rates(tmp_path: Path) -> None:
    folder = _experiment(tmp_path, "small", [_with_success(run, 1.0, 0.0) for run in _runs("A", 1.0)])
    assert "| A | success | 0.5 |" in page_text(leaderboard(_sources(folder), tmp_path))


def test_focal_by_the_literal_protocol_stands_for_idaq() -> None:
    focal = made_result("FOCAL", final=-7.0, protocols=("offline", "idaq_literal"), algorithm="focal")
    table = published_table("x", "point-robot-wind", [focal])
    assert table is not None
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    assert rows["IDAQ"]["ours, idaq_literal"] == -7.0 and rows["IDAQ"]["ours, offline"] is None


def test_the_command_writes_a_leaderboard(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = _experiment(tmp_path, "small", _runs("A", 1.0))
    code, output, _ = in_process(tcmrl, capsys)("report", folder, "--leaderboard", "--quiet")
    assert code == 0 and str(folder / "leaderboard/leaderboard.md") in output
    assert not (folder / "leaderboard/report.md").exists()
