"""Pages whose numbers come from committed results, and the documentation's own pages and reports."""

from typing import Any

import pytest

from benchmarks import recompute
from tcmrl_algo.reporting.pages import Pages, unmarked_numbers
from tcmrl_algo.reporting.returns import DatasetReturns, SnapshotReturns
from tcmrl_data import TrainingError
from tcmrl_data.foundation.records import write_record
from tests import experiments
from tests.experiments import made_result, write_results


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Pages:
    root = tmp_path_factory.mktemp("results")
    content: dict[str, Any] = experiments.tables(root, seeds=[0, 1, 2, 3, 4])
    content["claims"] = content["claims"][:1]
    finals = {"TCMRL": [1.0, 2.0, 3.0, 4.0, 5.0], "no context": [0.0] * 5}
    results = [
        made_result(method, seed, final, protocols=("offline", "paper"))
        for method, values in finals.items()
        for seed, final in enumerate(values)
    ]
    for result in results[:5]:
        result.evaluations["offline"]["tasks"][0]["success"] = result.seed / 10
    write_results(root / "small", content, results)
    stored = SnapshotReturns(step=None, train=1.0, test=4.0)
    record = DatasetReturns(
        environment="point-robot",
        root="0" * 64,
        profile="quick",
        train_tasks=1,
        test_tasks=1,
        snapshots=(stored,),
    )
    write_record(root / "small" / "datasets" / "point-robot.json", record)
    (root / "speed.json").write_text('{"cases": [{"seconds": 0.0123}, {"seconds": 1234.5}]}')
    return Pages(root)


PLACE = "small; point-robot; offline"


@pytest.mark.parametrize(
    ("shown", "key", "expected"),
    [
        ("0.00", f"{PLACE}; TCMRL; final", "3.00"),
        ("7", f"{PLACE}; TCMRL; regret", "-3"),
        ("−7.0", f"{PLACE}; TCMRL; regret", "−3.0"),
        ("0.00", f"{PLACE}; TCMRL; success", "0.20"),
        ("0.00", f"{PLACE}; TCMRL; over dataset", "0.75"),
        ("0.0", f"{PLACE}; claim 1; low", "1.0"),  # 3 - 2.776 × 0.7071
        ("0.0", f"{PLACE}; claim 1; high", "5.0"),
        ("0.000", f"{PLACE}; claim 1; p", "0.026"),  # 0.0132 under each of two protocols
        ("1.0", "speed.json; cases; 0; seconds; * 1000", "12.3"),
        ("1,000", "speed.json; cases; 1; seconds", "1,234"),
    ],
)
def test_a_marked_number_is_recomputed_with_its_decimals(
    pages: Pages, shown: str, key: str, expected: str
) -> None:
    text = f"It is {shown}<!-- = {key} --> and 7 more"
    rewritten = pages.rewritten(text)
    assert rewritten == f"It is {expected}<!-- = {key} --> and 7 more"
    assert pages.rewritten(rewritten) == rewritten


def test_a_marked_table_is_that_of_the_report(pages: Pages) -> None:
    text = "a\n<!-- returns small -->\nold\n<!-- end -->\nb\n<!-- claims small -->\n<!-- end -->\n"
    text += "<!-- boards small -->\n<!-- end -->\n"
    rewritten = pages.rewritten(text)
    assert "old" not in rewritten and rewritten.startswith("a\n") and "\nb\n" in rewritten
    assert "| offline | TCMRL | 5 | 3 |" in rewritten and "TCMRL ends higher" in rewritten
    assert "| TCMRL | 5 | 1 | 3 (" in rewritten
    assert pages.rewritten(rewritten) == rewritten


@pytest.mark.parametrize(
    "key",
    [
        f"{PLACE}; TCMLR; final",
        f"{PLACE}; TCMRL; finale",
        f"{PLACE}; no context; success",
        f"{PLACE}; claim 2; mean",
        "small; point-robot",
        "speed.json; cases; 2; seconds",
        "slow.json; cases",
    ],
)
def test_a_mark_that_names_no_number_is_refused(pages: Pages, key: str) -> None:
    with pytest.raises(TrainingError, match="names no number"):
        pages.rewritten(f"1.0<!-- = {key} -->")


def test_an_unknown_table_is_refused(pages: Pages) -> None:
    with pytest.raises(TrainingError, match="returns, claims"):
        pages.rewritten("<!-- means small -->\n<!-- end -->")


def test_numbers_without_a_mark_are_found() -> None:
    text = "A -1.5 and 2.25<!-- = x; y -->, `3.5`, [4.5](5.5.md), 1,234.5 of 2.13.0\n```\n6.5\n```\n"
    assert unmarked_numbers(text) == ["-1.5", "4.5", "1,234.5"]


@pytest.mark.sweep
def test_the_documentation_says_what_its_results_give() -> None:
    different = [
        str(file) for file, text in recompute.recomputed(recompute.ROOT) if file.read_text("utf-8") != text
    ]
    assert different == [], "run `python benchmarks/recompute.py`"
    assert list(recompute.unmarked(recompute.ROOT)) == []
