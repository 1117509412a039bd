"""Verdicts: paired differences, every protocol, Holm's correction, and what an interval covers."""

from pathlib import Path

import pytest

from tcmrl_algo.experiment.results import ContextMeasures, RunResult
from tcmrl_algo.experiment.spec import Claim, Experiment, read_experiment
from tcmrl_algo.report.statistics import Verdict, compare, correct, coverage, judge, measure
from tcmrl_data import TcmrlError
from tests import experiments
from tests.experiments import made_result, with_setting

NOISE = [-100.0, 50.0, 3.0, 77.0, -20.0]


def _runs(method: str, finals: list[float]) -> list[RunResult]:
    return [made_result(method, seed, final) for seed, final in enumerate(finals)]


def _judge(claim: Claim, results: list[RunResult]) -> Verdict:
    (found,) = correct([compare(claim, "point-robot", results, protocol="offline")])
    return found


@pytest.mark.parametrize(
    ("better", "worse", "metric", "verdict"),
    [
        ([2.0, 3.0, 4.0, 5.0, 6.0], [1.0, 2.0, 3.0, 4.0, 5.0], "final", "supported"),
        ([1.0, 2.0, 3.0, 4.0, 5.0], [2.0, 3.0, 4.0, 5.0, 6.0], "final", "contradicted"),
        ([1.0, 5.0, 1.0, 5.0, 1.0], [5.0, 1.0, 5.0, 1.0, 1.0], "final", "cannot tell"),
        ([0.1, 1.4, 0.1, 0.6, 0.5], [0.0, 0.0, 0.0, 0.0, 0.0], "final", "cannot tell"),  # by bootstrap not
        ([9.0, 9.0, 9.0, 9.0], [1.0, 1.0, 1.0, 1.0], "final", "cannot tell"),  # too few seeds
        ([1.0, 2.0, 3.0, 4.0, 5.0], [2.0, 3.0, 4.0, 5.0, 6.0], "regret", "contradicted"),  # lower is better
    ],
)
def test_a_verdict_follows_from_paired_differences(
    better: list[float], worse: list[float], metric: str, verdict: str
) -> None:
    claim = Claim(text="A beats B", better="A", worse="B", metric=metric)  # type: ignore[arg-type]
    found = _judge(claim, [*_runs("A", better), *_runs("B", worse)])
    assert found.verdict == verdict
    assert found.differences == tuple(a - b for a, b in zip(better, worse, strict=True))


def test_differences_are_paired_by_seed_and_large_common_noise_cancels() -> None:
    better, worse = _runs("A", [value + 1.0 for value in NOISE]), _runs("B", NOISE)
    found = _judge(Claim(text="", better="A", worse="B"), [*better, *worse[::-1]])
    assert (found.verdict, found.low, found.high) == ("supported", 1.0, 1.0)
    found = _judge(Claim(text="", better="A", worse="B"), [*better[:4], *worse[1:]])
    assert found.pairs == ((1, None), (2, None), (3, None))


def test_pairs_of_seed_and_fold_are_compared_with_each_other_alone() -> None:
    places = [(seed, fold) for seed in (0, 1, 2) for fold in (0, 1)]
    better = [made_result("A", seed, 100.0 * fold + seed + 1.0, fold=fold) for seed, fold in places]
    worse = [made_result("B", seed, 100.0 * fold + seed, fold=fold) for seed, fold in reversed(places)]
    found = _judge(Claim(text="", better="A", worse="B"), [*better, *worse])
    assert found.differences == (1.0,) * 6
    assert found.covers == "3 seeds × 2 folds, 2 test tasks"
    assert _judge(Claim(text="", better="A", worse="B"), [*better[1:], *worse]).covers == (
        "5 of 3 seeds × 2 folds, 2 test tasks"
    )


def test_an_interval_names_what_it_covers() -> None:
    assert coverage(_runs("A", NOISE)) == "5 seeds, 1 split, 1 test task"
    assert coverage([]) == "no run"


def test_a_verdict_marks_a_method_that_observes_task_parameters() -> None:
    control = [result.model_copy(update={"privileged": True}) for result in _runs("B", [1.0, 2.0])]
    found = _judge(Claim(text="", better="A", worse="B"), [*_runs("A", [1.0, 2.0]), *control])
    assert found.comparison == "A (final) against B (privileged) (final)"


def test_a_verdict_names_the_shared_settings_in_which_methods_differ() -> None:
    alike = _runs("A", [1.0, 2.0])
    other = [with_setting(result, "actor_critic", entropy=0.5) for result in _runs("B", [0.0, 0.0])]
    other = [with_setting(result, "run", threads=7) for result in other]
    entropy = alike[0].config.settings.actor_critic.entropy
    claim = Claim(text="", better="A", worse="B")
    assert _judge(claim, [*alike, *other]).unequal == (f"`actor_critic.entropy` {entropy}, 0.5",)
    assert _judge(claim, [*alike, *_runs("B", [0.0, 0.0])]).unequal == ()


def test_one_method_under_two_metrics_makes_a_claim() -> None:
    claim = Claim(text="", better="A", worse="A", against="shuffled")
    assert _judge(claim, [made_result("A", final=-5.0)]).differences == (1.0,)


def test_contexts_are_compared_by_what_a_report_measured() -> None:
    measured = ContextMeasures(tasks=20, context_ratio=0.25, attention_zero=0.5)
    result = made_result("A", contexts=measured)
    assert measure(result, "context_ratio", None) == 0.25
    assert measure(result, "attention_zero", None) == 0.5
    assert measure(result, "attention_nonzero", None) is None
    assert measure(made_result("A"), "context_ratio", None) is None


def _source(claims: list[dict[str, object]], results: list[RunResult]) -> tuple[Experiment, list[RunResult]]:
    content = experiments.tables(Path("nowhere"), claims=claims)
    content["protocols"] = ["offline", "paper", "idaq"]
    content["methods"] = {"A": {"algorithm": "tcmrl"}, "B": {"algorithm": "focal"}}
    experiment: Experiment = read_experiment(content, place="test")
    return experiment, results


def test_a_claim_is_judged_under_every_protocol_unless_it_names_some() -> None:
    claim = {"text": "A beats B", "better": "A", "worse": "B"}
    results = [made_result("A"), made_result("B")]
    source = _source(
        [claim, claim | {"protocols": ["idaq"]}, claim | {"metric": "training_seconds"}], results
    )
    assert [verdict.protocol for verdict in judge(*source)] == ["offline", "paper", "idaq", "idaq", None]


def test_a_registered_test_is_not_corrected_and_corrects_no_other() -> None:
    """One environment under the first protocol; p = 0.0132 as below, 5 × 0.0132 is above 0.05."""
    results = [
        made_result(method, seed, final, protocols=("offline", "paper"))
        for seed in range(5)
        for method, final in (("A", seed + 1.0), ("B", 0.0))
    ]
    claim = {"text": "", "better": "A", "worse": "B", "protocols": ["offline", "paper"]}
    others = [claim | {"metric": metric} for metric in ("normalized", "shuffled")]
    verdicts = judge(*_source([claim | {"registered": "point-robot"}, *others], results))
    first, *rest = verdicts
    assert (first.protocol, first.is_registered, first.verdict) == ("offline", True, "supported")
    assert first.adjusted == first.probability == pytest.approx(0.01324, abs=1e-5)
    assert [found.is_registered for found in rest] == [False] * 5
    assert [found.adjusted for found in rest] == [pytest.approx(5 * 0.013236, abs=1e-4)] * 5
    assert {found.verdict for found in rest} == {"cannot tell"}
    with pytest.raises(TcmrlError, match="registered for 'hopper'"):
        _source([claim | {"registered": "hopper"}], results)


def test_verdicts_are_corrected_for_their_number() -> None:
    """One of three equal verdicts of p = 0.0132 (t = 4.243 with 4 degrees of freedom) has 3 × 0.0132."""
    protocols = ("offline", "paper", "idaq")
    results = [
        made_result(method, seed, final, protocols=protocols)
        for seed in range(5)
        for method, final in (("A", seed + 1.0), ("B", 0.0))
    ]
    claim = {"text": "A beats B", "better": "A", "worse": "B"}
    (single,) = judge(*_source([claim | {"protocols": ["paper"]}], results))
    assert single.adjusted == single.probability == pytest.approx(0.01324, abs=1e-5)
    assert single.verdict == "supported"
    three = judge(*_source([claim], results))
    assert [verdict.adjusted for verdict in three] == [pytest.approx(3 * 0.013236, abs=1e-5)] * 3
    four = judge(*_source([claim, claim | {"metric": "normalized"}], results))
    assert {verdict.verdict for verdict in three} == {"supported"}
    assert {verdict.verdict for verdict in four} == {"cannot tell"}
