"""Tables of results, the page that is made of them, and the pages that quote them."""

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from tcmrl_cli.frame import number as shown
from tcmrl_cli.train import tcmrl

from tcmrl_algo import write_results_page
from tcmrl_algo.experiment.results import (
    ContextMeasures,
    CurvePoint,
    RunResult,
    Tuned,
    read_table,
    write_table,
)
from tcmrl_algo.report.results_page import PAGE, TEMPLATE, Numbers, number, page_of, read_numbers
from tcmrl_algo.report.rows import (
    CURVES,
    RUNS,
    WORTH,
    CurveRow,
    RunRow,
    WorthRow,
    run_rows,
    settings_digest,
)
from tcmrl_algo.report.sources import DatasetReturns, SnapshotReturns
from tcmrl_algo.report.statistics import mean_interval
from tcmrl_data import CheckpointError, TrainingError
from tests import experiments
from tests.commands import assert_refused, in_process
from tests.experiments import made_result, with_setting, write_results
from tests.workers import ROOT

RESULTS = ROOT / "results"


def _rows(method: str, *finals: float, root: str = "0" * 64, **changes: object) -> list[RunRow]:
    results = [made_result(method, seed, final, root=root, **changes) for seed, final in enumerate(finals)]
    return [row for result in results for row in run_rows("small", result, None)]


def _numbers(*groups: Sequence[RunRow]) -> Numbers:
    return Numbers([row for group in groups for row in group])


def test_a_row_has_the_means_the_costs_and_where_they_come_from() -> None:
    tuned = Tuned(
        environment="point-robot",
        root="a" * 64,
        profile="quick",
        trials=12,
        steps=2_000,
        seeds=(0,),
        score=0.5,
        overrides=(),
    )
    result = made_result(
        "TCMRL", 3, -2.0, fold=1, root="ab" * 32, tuned=tuned, privileged=True, commit="c", processor="p"
    ).model_copy(update={"contexts": ContextMeasures(tasks=2, context_ratio=0.25), "behavior_seed": 7})
    task = result.evaluations["offline"]["tasks"][0]
    result.evaluations["offline"]["tasks"][:] = [task | {"oracle": 1.0}, task | {"oracle": 2.0}]
    (row,) = run_rows("small", result, None)
    assert (row.experiment, row.environment, row.method, row.seed, row.fold) == (
        *("small", "point-robot", "TCMRL"),
        *(3, 1),
    )
    assert (row.final, row.shuffled, row.oracle, row.test_tasks) == (-2.0, -3.0, 1.5, 2)
    assert (row.root, row.digest) == ("ab" * 8, "1" * 16)
    assert (row.tuned, row.privileged, row.behavior_seed) == ("12 x 2000 on point-robot", True, 7)
    assert (row.actor_critic, row.snapshots, row.context_snapshots) == ("sac", "all", None)
    assert row.ms_per_step == pytest.approx(1e3 / 3 / 40, rel=1e-5)
    assert (row.peak_mb, row.context_ratio, row.centroid_accuracy) == (100.0, 0.25, None)
    assert (row.commit, row.processor, row.pair) == ("c", "p", ("ab" * 8, 1, 3))


def test_a_row_knows_how_the_policy_was_trained_and_on_what() -> None:
    result = made_result("A")
    cloned = with_setting(result, "actor_critic", cloning=1.0)
    last = with_setting(result, "run", snapshots="last", context_snapshots="all")
    (plain,), (row,), (other,) = (run_rows("small", one, None) for one in (result, cloned, last))
    assert (row.actor_critic, other.snapshots, other.context_snapshots) == ("sac+cloning", "last", "all")
    assert len({plain.settings, row.settings, other.settings}) == 3
    assert settings_digest(with_setting(result, "run", threads=2, log_every=7)) == plain.settings
    assert (plain.commit, plain.processor, plain.dataset_profile) == ("unknown", "unknown", None)
    stored = DatasetReturns(
        environment="point-robot",
        root="0" * 64,
        profile="paper",
        train_tasks=1,
        test_tasks=1,
        snapshots=(SnapshotReturns(step=None, train=1.0, test=4.0),),
    )
    (known,) = run_rows("small", result, stored)
    assert (known.dataset_profile, known.stored) == ("paper", 4.0)
    (foreign,) = run_rows("small", result, replace(stored, root="f" * 64))
    assert (foreign.dataset_profile, foreign.stored) == (None, None)


def test_results_of_earlier_versions_open() -> None:
    document = made_result("A").model_dump(mode="json", exclude={"commit", "processor", "behavior_seed"})
    old = RunResult.model_validate(document)
    assert (old.commit, old.processor, old.behavior_seed) == (None, None, None)


def test_tables_come_back_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / RUNS
    changes = {"regret": None, "privileged": True, "ms_per_step": 0.25}
    rows = [replace(row, **changes, final=1 / 3) for row in _rows('A, "quoted"', 1.0, 2.0)]
    write_table(RunRow, file, rows)
    assert read_table(RunRow, file) == [replace(row, final=0.333333) for row in rows]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("experiment,", "trial,", "columns"),
        (",offline,1,", ",offline,one,", r"line 2: .*'one'"),
        (",offline,1,", ",offline,,", "line 2"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, old: str, new: str, problem: str) -> None:
    file = tmp_path / RUNS
    write_table(RunRow, file, _rows("A", 1.0))
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))
    with pytest.raises(CheckpointError, match=problem):
        read_table(RunRow, file)
    with pytest.raises(CheckpointError, match="No such file"):
        read_table(RunRow, tmp_path / "none.csv")


def test_a_difference_is_by_hand_and_never_crosses_datasets() -> None:
    """Differences 1, 2 and 3: mean 2, standard error sqrt(1/3), t of two degrees 4.3027."""
    numbers = _numbers(_rows("A", 2.0, 4.0, 6.0), _rows("B", 1.0, 2.0, 3.0, 99.0))
    found = numbers.difference("small", "point-robot", "offline", "A", "B")
    assert (found.mean, found.pairs, found.probability) == (2.0, 3, None)
    assert (found.low, found.high) == pytest.approx((2 - 4.3027 / 3**0.5, 2 + 4.3027 / 3**0.5), abs=1e-3)
    assert str(found) == "2.00 (-0.484 to 4.48)"
    own = numbers.difference("small", "point-robot", "offline", "A", "A", other_column="shuffled")
    assert own.mean == 1.0
    elsewhere = _numbers(_rows("A", 2.0), _rows("B", 1.0, root="f" * 64))
    with pytest.raises(TrainingError, match="share no data"):
        elsewhere.difference("small", "point-robot", "offline", "A", "B")
    with pytest.raises(TrainingError, match="different datasets"):
        elsewhere.board("small", "point-robot")


def test_a_share_divides_run_by_run_before_it_averages() -> None:
    """1 of 2 and 3 of 4 are 0.625, where the means 2 and 3 would say 0.667; s = sqrt(1/32), t(1) = 12.706."""
    rows = [replace(row, behavior=own) for row, own in zip(_rows("A", 1.0, 3.0), (2.0, 4.0), strict=True)]
    half = 12.7062 * (1 / 32 / 2) ** 0.5
    expected = f"0.625 ({number(0.625 - half)} to {number(0.625 + half)})"
    assert Numbers(rows).share("small", "point-robot", "A", "offline") == expected


def test_curves_are_compared_by_the_means_of_their_points_run_by_run() -> None:
    """Means 2 and 5 of A, 1 and 3 of B: differences 1 and 2."""

    def curve(method: str, seed: int, *finals: float) -> list[CurveRow]:
        place = ("small", "point-robot", "1" * 16, method, seed, None, "offline")
        return [CurveRow(*place, 10 * (step + 1), final, 0.0) for step, final in enumerate(finals)]

    curves = [
        *curve("A", 0, 1.0, 3.0),
        *curve("A", 1, 5.0, 5.0),
        *curve("B", 0, 1.0),
        *curve("B", 1, 0.0, 6.0),
    ]
    numbers = Numbers([], curves)
    found = numbers.curve_difference("small", "point-robot", "A", "B")
    assert (found.mean, found.pairs) == (1.5, 2)
    with pytest.raises(TrainingError, match="share no data"):
        numbers.curve_difference("small", "point-robot", "A", "C")


def test_runs_on_several_datasets_compare_within_each() -> None:
    roots = ("1" * 64, "2" * 64)
    numbers = _numbers(*(_rows("A", 5.0 + place, root=root) for place, root in enumerate(roots)))
    numbers = Numbers([*numbers.rows, *_rows("B", 1.0, root=roots[0]), *_rows("B", 4.0, root=roots[1])])
    found = numbers.difference("small", "point-robot", "offline", "A", "B")
    assert (found.mean, found.pairs) == (3.0, 2)
    assert "| A | 2 | 5.50 (" in numbers.board("small", "point-robot")


def test_a_board_sorts_methods_below_what_they_are_compared_with() -> None:
    numbers = _numbers(
        _rows("blind", 0.0, 0.0, 0.0, 0.0, 0.0, algorithm="no_context"),
        _rows("A", 1.0, 2.0, 3.0, 4.0, 5.0),
        _rows("known", 9.0, 9.0, 9.0, 9.0, 9.0, privileged=True),
    )
    lines = numbers.board("small", "point-robot", ["offline"], compared="A").splitlines()
    assert lines[2].startswith("| *controller that knows the task* |  | 0.000 |")
    assert lines[3].startswith("| *uniform actions* |  | -20.0 |")
    assert lines[4].startswith(
        "| known (privileged) | 5 | 9.00 (9.00 to 9.00) | 8.00 | -6.00 (-7.96 to -4.04) | 0.0"
    )
    assert lines[5].startswith("| A | 5 | 3.00 (1.04 to 4.96) | 2.00 |  |  |")
    assert lines[6].startswith("| blind | 5 | 0.000 (0.000 to 0.000) |  | 3.00 (1.04 to 4.96) | 0.013 |")
    short = [replace(row, policy_steps=1) if row.method == "blind" else row for row in numbers.rows]
    assert "| blind (1 steps for the policy) | 5 |" in Numbers(short).board("small", "point-robot")
    in_training = [replace(row, protocol="offline_train", random=-30.0) for row in numbers.rows]
    both = Numbers([*numbers.rows, *in_training])
    assert both.board("small", "point-robot", ["offline"], compared="A").splitlines() == lines


def test_a_gain_is_a_share_of_the_range_over_the_blind_learner() -> None:
    """From -10 to 0, of a range from -20 to 0; the known task does not count."""
    blind = _rows("blind", -12.0, -8.0, algorithm="no_context")
    others = (_rows("A", 1.0, -1.0), _rows("B", -8.0, -4.0), _rows("known", 9.0, 9.0, privileged=True))
    assert _numbers(blind, *others).gained("small", "point-robot", "offline") == ("A", 0.5)
    without_oracle = [replace(row, oracle=None, behavior=20.0) for row in (*blind, *others[1])]
    assert _numbers(without_oracle).gained("small", "point-robot", "offline") == ("B", 0.1)
    for rows in (others, (blind,), ([replace(row, random=None) for row in blind], *others)):
        with pytest.raises(TrainingError, match="not known"):
            _numbers(*rows).gained("small", "point-robot", "offline")


@pytest.mark.parametrize(
    ("value", "text"),
    [(-4.5687, "-4.57"), (12.61, "12.6"), (-302.4, "-302"), (3747.2, "3,747"), (0.06, "0.060")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def _experiment(folder: Path, *finals: float) -> Path:
    content = experiments.tables(folder, methods={"TCMRL": {"algorithm": "tcmrl"}}, claims=[])
    shared = {"stage": "train", "regret": None, "normalized": None, "shuffled": 0.0, "timed_steps": 20}
    shared |= {"seconds": 1.0, "evaluation_seconds": 1.0, "peak_memory": 1, "device_memory": 0}
    curve = [CurvePoint.model_validate(shared | {"step": step, "final": step / 10}) for step in (20, 40)]
    results = [made_result("TCMRL", seed, final, curve=curve) for seed, final in enumerate(finals)]
    return write_results(folder, content, results)


def test_the_command_adds_runs_replaces_them_and_writes_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call, table = in_process(tcmrl, capsys), tmp_path / "boards" / RUNS
    first, second = _experiment(tmp_path / "first", 1.0, 2.0), _experiment(tmp_path / "second", 5.0, 6.0)
    for folder in (first, second, first):
        code, output, errors = call("report", folder, "--rows", table, "--quiet")
        assert code == 0 and str(table) in output, errors
        assert (folder / "report/report.md").is_file()
    rows = read_table(RunRow, table)
    assert [(row.experiment, row.seed, row.final) for row in rows] == [
        ("first", 0, 1.0),
        ("first", 1, 2.0),
        ("second", 0, 5.0),
        ("second", 1, 6.0),
    ]
    assert len(read_table(CurveRow, table.with_name(CURVES))) == 8
    shutil.rmtree(first)
    call("report", _experiment(first, 3.0), "--rows", table, "--quiet")
    assert [row.final for row in read_table(RunRow, table)] == [3.0, 2.0, 5.0, 6.0]
    code, output, errors = call("report", table)
    assert code == 0 and str(table.with_name(PAGE)) in output, errors
    page = table.with_name(PAGE).read_text()
    assert "## point-robot: second" in page and "| TCMRL | 2 | 5.50 (-0.853 to 11.9) |" in page
    assert_refused(call("report", table, "--rows", table), "one table")


def test_the_command_adds_what_a_context_is_worth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call, table = in_process(tcmrl, capsys), tmp_path / WORTH
    document = tmp_path / "mine.json"
    document.write_text(
        '{"label": null, "environment": "point-robot", "root": "' + "a" * 64 + '", "seed": 0, "episodes": 5,'
        '"transitions": 500, "neighbours": 5, "left_out": 0, "single_task": 0, "splits": [{"split": "train",'
        '"tasks": 2, "own": -1.0, "single": -3.0, "uniform": -5.0, "best": -1.0, "worth": 0.5, "low": null,'
        '"high": null}], "stages": [{"step": 0, "split": "train", "tasks": 2, "rewarded": 0.25,'
        '"reward": 0.5,'
        '"dynamics": null}, {"step": 9, "split": "train", "tasks": 2, "rewarded": 1.0, "reward": 0.75,'
        '"dynamics": 0.0}]}'
    )
    code, output, errors = call("report", document, "--rows", table)
    assert code == 0 and "1 rows" in output, errors
    (row,) = read_table(WorthRow, table)
    assert (row.dataset, row.split, row.worth, row.root) == ("mine", "train", 0.5, "a" * 16)
    assert (row.rewarded_first, row.rewarded_last, row.reward_last, row.dynamics_first) == (
        0.25,
        1.0,
        0.75,
        None,
    )


@pytest.mark.parametrize(
    "asked",
    ['mean("small", "point-robot", "B", "offline")', 'score("x-tcmrl")', 'worth("x")', "median(1)", "x.y"],
)
def test_a_template_that_asks_for_what_is_not_there_is_refused(tmp_path: Path, asked: str) -> None:
    write_table(RunRow, tmp_path / RUNS, _rows("A", 1.0))
    (tmp_path / TEMPLATE).write_text("{{ " + asked + " }}")
    with pytest.raises(TrainingError):
        write_results_page(tmp_path / RUNS)
    assert not (tmp_path / PAGE).exists()


def test_the_page_of_our_results_is_up_to_date() -> None:
    made = page_of(RESULTS / RUNS, read_numbers(RESULTS / RUNS))
    assert made == (RESULTS / PAGE).read_text(encoding="utf-8"), "run `make results`"


def test_no_measured_number_of_the_page_is_typed_by_hand() -> None:
    words = (RESULTS / TEMPLATE).read_text(encoding="utf-8")
    prose = re.sub(r"\{\{.*?\}\}|\{%.*?%\}", "", words, flags=re.DOTALL)
    assert re.findall(r"\d+\.\d+", prose) == []


def test_the_pages_of_the_tour_quote_the_table() -> None:
    numbers = read_numbers(RESULTS / RUNS)
    place = ("tour", "point-robot")
    for page in ("README.md", "docs/tour.md"):
        words = [line.split() for line in (ROOT / page).read_text(encoding="utf-8").splitlines()]
        for method in ("TCMRL", "no context"):
            finals = numbers.values(*place, method, "offline")
            interval = mean_interval(finals)
            assert interval is not None
            low, high = interval
            mean, other, regret = (
                shown(numbers.mean(*place, method, "offline", column))
                for column in ("final", "shuffled", "regret")
            )
            line = [*method.split(), "5", mean, shown(low), "to", shown(high), other, regret]
            assert line in words, (page, line)
    worth = numbers.worth("point-robot-quick").worth
    assert worth is not None
    assert f"{100 * worth:.0f}% of the range" in (ROOT / "README.md").read_text(encoding="utf-8")
