"""Verdicts on the claims of an experiment, from the differences between two methods run by run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from tcmrl_algo.experiment.aggregate import CONFIDENCE, holm, mean_interval, sign_probability
from tcmrl_algo.experiment.results import RunResult, coverage
from tcmrl_algo.experiment.spec import Claim, Metric
from tcmrl_algo.reporting.fairness import unequal_settings
from tcmrl_algo.reporting.sources import Source

LOWER_IS_BETTER = frozenset({"regret", "training_seconds", "peak_memory", "context_ratio"})
WITHOUT_PROTOCOL = frozenset(
    {"curve", "training_seconds", "peak_memory", "context_ratio", "attention_zero", "attention_nonzero"}
)
"""Metrics of a run, whatever it is evaluated by; the curve is that of the experiment's first protocol."""
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "cannot tell"


@dataclass(frozen=True)
class Verdict:
    """Verdict on a claim in one environment, under one protocol.

    Attributes:
        claim: text of the claim.
        environment: name of the environment.
        comparison: the methods and metrics that were compared; privileged methods are marked.
        protocol: of evaluation; None if the metrics do not depend on it.
        pairs: seed and fold of the runs that both methods have; the fold is None without folds.
        differences: one per pair, positive if `better` is better.
        mean: mean of the differences; None if there are none.
        low, high: 95% interval of the mean by Student's t, uncorrected; None with fewer than five pairs.
        probability: two-sided p value against a mean of 0, with Student's t; None as the interval.
        is_registered: the claim was written before its runs, and this is the one test that decides it.
        adjusted: the p value; of a test that is not registered, corrected for all such verdicts of the
            experiment by Holm's method.
        covers: what interval and p value cover: numbers of seeds, folds and test tasks.
        unequal: settings that all methods share and in which these two differ, as `key left, right`.
        verdict: `supported` or `contradicted`, by the sign of the mean, if `adjusted` is below 0.05, else
            `cannot tell`.
    """

    claim: str
    environment: str
    comparison: str
    protocol: str | None
    pairs: tuple[tuple[int, int | None], ...]
    differences: tuple[float, ...]
    mean: float | None
    low: float | None
    high: float | None
    probability: float | None
    is_registered: bool
    adjusted: float | None
    covers: str
    unequal: tuple[str, ...]
    verdict: str


def judge(source: Source) -> list[Verdict]:
    """Verdicts on all claims of an experiment, in its environments, under its protocols."""
    primary = source.experiment.protocols[0]
    compared = [
        replace(
            compare(claim, environment, source.results(environment), protocol=protocol),
            is_registered=claim.registered == environment and protocol in (primary, None),
        )
        for claim in source.experiment.claims
        for environment in source.environments()
        for protocol in _protocols(claim, source.experiment.protocols)
    ]
    return correct(compared)


def correct(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """The verdicts, by the p value where they are registered, else by Holm's correction for all others."""
    explored = [found.probability for found in verdicts if not found.is_registered]
    corrected = iter(holm([value for value in explored if value is not None]))
    return [
        found
        if found.probability is None
        else _decided(replace(found, adjusted=found.probability if found.is_registered else next(corrected)))
        for found in verdicts
    ]


def compare(claim: Claim, environment: str, results: Sequence[RunResult], *, protocol: str | None) -> Verdict:
    """The comparison that a claim asks for; `correct` decides what it says.

    Args:
        claim: the claim.
        environment: name of the environment.
        results: of the runs in the environment.
        protocol: the protocol; None for metrics that do not depend on it.
    """
    against = claim.against or claim.metric
    better = _by_pair(results, claim.better, claim.metric, protocol)
    worse = _by_pair(results, claim.worse, against, protocol)
    pairs = tuple(sorted(better.keys() & worse.keys(), key=str))
    sign = -1.0 if claim.metric in LOWER_IS_BETTER else 1.0
    gains = tuple(sign * (better[pair] - worse[pair]) for pair in pairs)
    low, high = mean_interval(gains) or (None, None)
    labels = {result.method: result.label for result in results}
    left, right = (labels.get(method, method) for method in (claim.better, claim.worse))
    first, second = (
        [result for result in results if result.method == method and result.pair in pairs]
        for method in (claim.better, claim.worse)
    )
    unequal = unequal_settings(first[0], second[0]) if pairs else {}
    return Verdict(
        claim=claim.text,
        environment=environment,
        comparison=f"{left} ({claim.metric}) against {right} ({against})",
        protocol=protocol,
        pairs=pairs,
        differences=gains,
        mean=fmean(gains) if gains else None,
        low=low,
        high=high,
        probability=sign_probability(gains),
        is_registered=False,
        adjusted=None,
        covers=coverage(first),
        unequal=tuple(f"`{key}` {one}, {other}" for key, (one, other) in unequal.items()),
        verdict=UNDECIDED,
    )


def measure(result: RunResult, metric: Metric, protocol: str | None) -> float | None:
    """Value of a metric that a result contains; `curve` is the mean over the points of the learning curve.

    `curve` measures sample efficiency; it always uses the first protocol of the experiment.
    """
    if metric == "curve":
        return sum(point.final for point in result.curve) / len(result.curve) if result.curve else None
    value: float | None
    if metric in ("training_seconds", "peak_memory"):
        value = getattr(result, metric)
        return value
    if metric in WITHOUT_PROTOCOL:
        value = None if result.contexts is None else getattr(result.contexts, metric)
        return value
    evaluation = result.evaluations.get(protocol or "", {})
    return evaluation.get(f"mean_{metric}")


def _protocols(claim: Claim, protocols: tuple[str, ...]) -> tuple[str | None, ...]:
    if {claim.metric, claim.against or claim.metric} <= WITHOUT_PROTOCOL:
        return (None,)
    return claim.protocols or protocols


def _by_pair(
    results: Sequence[RunResult], method: str, metric: Metric, protocol: str | None
) -> dict[tuple[int, int | None], float]:
    values = {result.pair: measure(result, metric, protocol) for result in results if result.method == method}
    return {pair: value for pair, value in values.items() if value is not None}


def _decided(found: Verdict) -> Verdict:
    if found.adjusted is None or found.mean is None or found.adjusted >= 1 - CONFIDENCE:
        return found
    return replace(found, verdict=SUPPORTED if found.mean > 0 else CONTRADICTED)
