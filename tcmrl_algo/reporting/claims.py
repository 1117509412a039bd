"""Verdicts on the claims of an experiment, from the differences between two methods seed by seed."""

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
"""Returns the value of a run's metric with a protocol, None if it has none."""


@dataclass(frozen=True)
class Verdict:
    """Verdict on a claim in one environment.

    Attributes:
        claim: text of the claim.
        environment: name of the environment.
        comparison: the methods and metrics that were compared; privileged methods are marked.
        seeds: seeds that both methods have.
        differences: one per seed, positive if `better` is better.
        mean: mean of the differences; None if there are none.
        low, high: 95% interval of the mean by Student's t; None with fewer than five seeds.
        verdict: `supported` if the interval is above 0, `contradicted` if it is below 0, else `cannot tell`.
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
        environment: name of the environment.
        runs: finished runs in the environment.
        protocol: the protocol, unless the claim names one.
        measure: returns the value of a run's metric.
    """
    protocol, against = claim.protocol or protocol, claim.against or claim.metric
    better = _by_seed(runs, claim.better, claim.metric, protocol, measure)
    worse = _by_seed(runs, claim.worse, against, protocol, measure)
    seeds = tuple(sorted(better.keys() & worse.keys()))
    sign = -1.0 if claim.metric in LOWER_IS_BETTER else 1.0
    differences = tuple(sign * (better[seed] - worse[seed]) for seed in seeds)
    low, high = mean_interval(differences) or (None, None)
    labels = {run.result.method: run.result.label for run in runs}
    left, right = (labels.get(method, method) for method in (claim.better, claim.worse))
    return Verdict(
        claim=claim.text,
        environment=environment,
        comparison=f"{left} ({claim.metric}) against {right} ({against}), {protocol}",
        seeds=seeds,
        differences=differences,
        mean=fmean(differences) if differences else None,
        low=low,
        high=high,
        verdict=_verdict(low, high),
    )


def measure_result(result: RunResult, metric: Metric, protocol: str) -> float | None:
    """Value of a metric that a result contains; `curve` is the mean over the points of the learning curve.

    `curve` measures sample efficiency; it always uses the first protocol of the experiment.
    """
    if metric == "curve":
        return sum(point.final for point in result.curve) / len(result.curve) if result.curve else None
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
