"""Verdicts on an experiment's claims, from differences between methods seed by seed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

from tcmrl_algo.experiment.aggregate import mean_interval
from tcmrl_algo.experiment.config import Claim, Metric
from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.reporting.sources import FinishedRun

LOWER_IS_BETTER = frozenset({"regret", "training_seconds", "peak_memory"})
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "cannot tell"

Measure = Callable[[FinishedRun, Metric, str], float | None]
"""A run's value of a metric under a protocol, None where it has none."""


@dataclass(frozen=True)
class Verdict:
    """What the runs say of a claim in one environment.

    Attributes:
        claim: in words.
        environment: where.
        comparison: what was compared with what.
        seeds: that both sides have.
        differences: one per seed, positive where `better` is better.
        mean: of the differences; None without one.
        low, high: 95% interval of their mean by Student's t; None under five seeds.
        verdict: `supported` where the interval lies above 0, `contradicted` where below, else `cannot tell`.
    """

    claim: str
    environment: str
    comparison: str
    seeds: tuple[int, ...]
    differences: tuple[float, ...]
    mean: float | None
    low: float | None
    high: float | None
    verdict: str


def judge(
    claim: Claim, environment: str, runs: Sequence[FinishedRun], *, protocol: str, measure: Measure
) -> Verdict:
    """The verdict on a claim.

    Args:
        claim: the claim.
        environment: where.
        runs: finished there.
        protocol: used where the claim names none.
        measure: gives a run's value.
    """
    protocol, against = claim.protocol or protocol, claim.against or claim.metric
    better = _by_seed(runs, claim.better, claim.metric, protocol, measure)
    worse = _by_seed(runs, claim.worse, against, protocol, measure)
    seeds = tuple(sorted(better.keys() & worse.keys()))
    sign = -1.0 if claim.metric in LOWER_IS_BETTER else 1.0
    differences = tuple(sign * (better[seed] - worse[seed]) for seed in seeds)
    low, high = mean_interval(differences) or (None, None)
    return Verdict(
        claim=claim.text,
        environment=environment,
        comparison=f"{claim.better} ({claim.metric}) against {claim.worse} ({against}), {protocol}",
        seeds=seeds,
        differences=differences,
        mean=fmean(differences) if differences else None,
        low=low,
        high=high,
        verdict=_verdict(low, high),
    )


def measure_result(result: RunResult, metric: Metric, protocol: str) -> float | None:
    """A metric that the result itself holds; `curve` is the mean over the learning curve's points.

    `curve` tells sample efficiency; it is by the experiment's first protocol, whatever is asked for.
    """
    if metric == "curve":
        return sum(each.final for each in result.curve) / len(result.curve) if result.curve else None
    if metric in ("training_seconds", "peak_memory"):
        value: float | None = getattr(result, metric)
        return value
    evaluation = result.evaluations.get(protocol, {})
    return evaluation.get(f"mean_{metric}")


def _by_seed(
    runs: Sequence[FinishedRun], method: str, metric: Metric, protocol: str, measure: Measure
) -> dict[int, float]:
    values = {run.result.seed: measure(run, metric, protocol) for run in runs if run.result.method == method}
    return {seed: value for seed, value in values.items() if value is not None}


def _verdict(low: float | None, high: float | None) -> str:
    if low is not None and low > 0:
        return SUPPORTED
    return CONTRADICTED if high is not None and high < 0 else UNDECIDED
