"""Columns of a report beside the returns, and what it says of runs that are missing."""

from dataclasses import replace
from pathlib import Path

from tcmrl_algo.experiment.results import RunResult, success_rate
from tcmrl_algo.experiment.spec import run_id
from tcmrl_algo.report.sources import read_sources
from tcmrl_algo.report.statistics import over_dataset
from tcmrl_algo.report.tables import final_table
from tests import experiments
from tests.experiments import made_result, write_results


def test_missing_runs_are_counted_by_method_or_environment_and_failed_ones_named(tmp_path: Path) -> None:
    content = experiments.tables(tmp_path, claims=[], methods={"A": {"algorithm": "tcmrl"}}, seeds=[0])
    folder = write_results(tmp_path / "one", content, [made_result("A", 0, 1.0)])
    (source,) = read_sources([folder])
    runs = [("point-robot", "B", 1), ("point-robot", "B", 2), ("ml1/reach", "A", 0), ("ml1/reach", "B", 0)]
    unfinished = {run_id(*run): None for run in runs} | {run_id("point-robot", "A", 1): "diverged"}
    assert replace(source, unfinished=unfinished).missing == [
        "`point-robot--a--seed1` (diverged)",
        "2 of `point-robot--b`",
        "2 of `ml1-reach`",
    ]


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


def _with_success(run: RunResult, *shares: float | None) -> RunResult:
    evaluations = {
        protocol: evaluation | {"tasks": [evaluation["tasks"][0] | {"success": share} for share in shares]}
        for protocol, evaluation in run.evaluations.items()
    }
    return run.model_copy(update={"evaluations": evaluations})
