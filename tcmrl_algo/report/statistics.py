"""What may be said across runs: means and intervals, and verdicts on claims from differences run by run."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean, stdev
from typing import Any

import numpy as np

from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_algo.experiment.results import RunResult, success_rate
from tcmrl_algo.experiment.spec import Claim, Experiment, Metric
from tcmrl_data import TrainingError
from tcmrl_data.foundation.records import differences

FEWEST_SEEDS = 5
"""Below this many, the seeds themselves say more than an interval would."""
CONFIDENCE = 0.95
LOWER_IS_BETTER = frozenset({"regret", "training_seconds", "peak_memory", "context_ratio"})
WITHOUT_PROTOCOL = frozenset(
    {"curve", "training_seconds", "peak_memory", "context_ratio", "attention_zero", "attention_nonzero"}
)
"""Metrics of a run, whatever it is evaluated by; the curve is that of the experiment's first protocol."""
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "cannot tell"
UNCOMPARED = frozenset({"run.algorithm", "run.threads"})
"""Settings by which two methods always differ, or which shape no more than last bits."""
Score = Callable[[Mapping[str, Any]], float | None]
SCORES = """\
`success` is the share of successful final episodes; `over dataset` is the return over the mean return of \
the stored episodes of the test tasks, where that is positive."""


@dataclass(frozen=True)
class Summary:
    """A quantity across seeds.

    Attributes:
        values: one per seed, in the order given.
        iqm: interquartile mean, without the lowest and the highest quarter (sizes rounded down).
        low, high: 95% interval of the mean by Student's t, None under FEWEST_SEEDS.
    """

    values: tuple[float, ...]
    mean: float
    iqm: float
    low: float | None
    high: float | None


def summarize(values: Sequence[float]) -> Summary:
    """Mean, interquartile mean and 95% interval of one value per seed.

    The interval is Student's t: the percentile bootstrap of the paper's section 5.2 holds the true mean of
    five normal values in only 84% of cases.

    Raises:
        TrainingError: no value, or one that is not finite.

    Example:
        >>> summarize([1.0, 2.0, 6.0])
        Summary(values=(1.0, 2.0, 6.0), mean=3.0, iqm=3.0, low=None, high=None)
    """
    array = np.array(values, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all():
        raise TrainingError(f"only finite values of one or more seeds can be summarised, not {list(values)}")
    low, high = mean_interval(array.tolist()) or (None, None)
    return Summary(
        values=tuple(array.tolist()),
        mean=float(array.mean()),
        iqm=float(np.sort(array)[len(array) // 4 : len(array) - len(array) // 4].mean()),
        low=low,
        high=high,
    )


def sign_probability(differences: Sequence[float]) -> float | None:
    """Two-sided p value of Student's t against a mean of 0, None under FEWEST_SEEDS.

    It is below 0.05 if and only if 0 is outside the interval of `mean_interval`.

    Example:
        >>> f"{sign_probability([1.0, 2.0, 3.0, 4.0, 5.0]):.4f}"
        '0.0132'
    """
    from scipy.special import stdtr

    if len(differences) < FEWEST_SEEDS:
        return None
    mean, error = _mean_and_error(differences)
    if error == 0:
        return 1.0 if mean == 0 else 0.0
    return float(2 * stdtr(len(differences) - 1, -abs(mean) / error))


def holm(probabilities: Sequence[float]) -> list[float]:
    """P values adjusted for their number by Holm's step-down method (Holm, 1979), in the order given.

    The i-th smallest of n is multiplied by n - i + 1, and none is less than a smaller one's. Verdicts at 0.05
    then err in at least one of n cases with a probability of at most 0.05, whatever their dependence.

    Example:
        >>> holm([0.03, 0.01, 0.04])
        [0.06, 0.03, 0.06]
    """
    adjusted, least = [0.0] * len(probabilities), 0.0
    for rank, place in enumerate(sorted(range(len(probabilities)), key=probabilities.__getitem__)):
        least = max(least, min(1.0, probabilities[place] * (len(probabilities) - rank)))
        adjusted[place] = least
    return adjusted


def mean_interval(values: Sequence[float], *, fewest: int = FEWEST_SEEDS) -> tuple[float, float] | None:
    """95% interval of the mean by Student's t, None of fewer than `fewest` values.

    Example:
        >>> low, high = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
        >>> f"{low:.3f} {high:.3f}"
        '1.037 4.963'
    """
    from scipy.special import stdtrit

    if len(values) < fewest:
        return None
    mean, error = _mean_and_error(values)
    reach = float(stdtrit(len(values) - 1, (1 + CONFIDENCE) / 2)) * error
    return mean - reach, mean + reach


def _mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """The mean, and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def by_method(results: Iterable[RunResult]) -> dict[str, list[RunResult]]:
    """Results of every method, in the order given, by its `label`."""
    found: dict[str, list[RunResult]] = {}
    for result in results:
        found.setdefault(result.label, []).append(result)
    return found


def coverage(results: Sequence[RunResult]) -> str:
    """What an interval over these runs covers, such as `5 seeds, 1 split, 4 test tasks`.

    Runs without folds share one split of one dataset, so that an interval over them covers the training
    alone. With folds every task is a test task in one of them: it covers training on these splits.
    """
    seeds, folds = {result.seed for result in results}, {result.fold for result in results}
    tasks = {
        (task["task"], result.environment)
        for result in results
        for evaluation in result.evaluations.values()
        for task in evaluation["tasks"]
    }
    runs = _count(len(seeds), "seed")
    if folds - {None}:
        whole = len(results) % (len(seeds) * len(folds)) == 0
        runs = f"{'' if whole else f'{len(results)} of '}{runs} × {_count(len(folds), 'fold')}"
    else:
        runs += ", 1 split"
    return f"{runs}, {_count(len(tasks), 'test task')}" if results else "no run"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def over_dataset(evaluation: Mapping[str, Any], stored: float | None) -> float | None:
    """Return over the mean return of the test tasks' stored episodes.

    None where that is unknown or not positive: a quotient of negative returns is greater for worse policies.

    Example:
        >>> over_dataset({"mean_final": 6.0}, 4.0), over_dataset({"mean_final": -6.0}, -4.0)
        (1.5, None)
    """
    final: float = evaluation["mean_final"]
    return final / stored if stored is not None and stored > 0 else None


def known_scores(results: Sequence[RunResult], stored: float | None) -> dict[str, Score]:
    """The scores that some run has, by the names of their columns.

    Args:
        stored: mean return of the stored episodes of the test tasks; None where unknown.
    """
    scores: dict[str, Score] = {"success": success_rate, "over dataset": partial(over_dataset, stored=stored)}
    found = [evaluation for run in results for evaluation in run.evaluations.values()]
    return {
        name: score
        for name, score in scores.items()
        if any(score(evaluation) is not None for evaluation in found)
    }


def unequal_settings(left: RunResult, right: RunResult) -> dict[str, tuple[Any, Any]]:
    """Both values of the shared settings that differ in two runs, by key such as `actor_critic.entropy`."""
    found = differences(_shared(left), _shared(right))
    return {key: (ours, theirs) for key, ours, theirs in found if key not in UNCOMPARED}


def _shared(result: RunResult) -> dict[str, Any]:
    settings = result.config.settings
    return {name: getattr(settings, name).model_dump(mode="json") for name in TrainingSettings.model_fields}


@dataclass(frozen=True)
class Verdict:
    """Verdict on a claim in one environment, under one protocol.

    Attributes:
        comparison: the methods and metrics that were compared; privileged methods are marked.
        protocol: of evaluation; None if the metrics do not depend on it.
        pairs: seed and fold of the runs that both methods have; the fold is None without folds.
        differences: one per pair, positive if `better` is better.
        mean: mean of the differences; None if there are none.
        low, high: 95% interval of the mean by Student's t, uncorrected; None with fewer than five pairs.
        effect: mean over standard deviation of the differences (Cohen's d of pairs); None where they are
            equal or fewer than two.
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
    effect: float | None
    probability: float | None
    is_registered: bool
    adjusted: float | None
    covers: str
    unequal: tuple[str, ...]
    verdict: str


def judge(experiment: Experiment, results: Sequence[RunResult]) -> list[Verdict]:
    """Verdicts on all claims of an experiment, where both methods of a claim are run, under its protocols."""
    primary = experiment.protocols[0]
    compared = [
        replace(
            compare(
                claim,
                environment,
                [result for result in results if result.environment == environment],
                protocol=protocol,
            ),
            is_registered=claim.registered == environment and protocol in (primary, None),
        )
        for claim in experiment.claims
        for environment in dict.fromkeys(result.environment for result in results)
        if all(experiment.methods[label].runs_in(environment) for label in (claim.better, claim.worse))
        for protocol in _protocols(claim, experiment.protocols)
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
        effect=_effect(gains),
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


def _effect(gains: Sequence[float]) -> float | None:
    deviation = stdev(gains) if len(gains) > 1 else 0.0
    return fmean(gains) / deviation if deviation else None


def _decided(found: Verdict) -> Verdict:
    if found.adjusted is None or found.mean is None or found.adjusted >= 1 - CONFIDENCE:
        return found
    return replace(found, verdict=SUPPORTED if found.mean > 0 else CONTRADICTED)
