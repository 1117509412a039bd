"""Scores of a run beside its return: success rate, and return over the dataset's."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from tcmrl_algo.experiment.results import RunResult, success_rate

Score = Callable[[Mapping[str, Any]], float | None]
SCORES = """\
`success` is the share of successful final episodes; `over dataset` is the return over the mean return of \
the stored episodes of the test tasks, where that is positive."""


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
        results: of the runs.
        stored: mean return of the stored episodes of the test tasks; None where unknown.
    """
    scores: dict[str, Score] = {"success": success_rate, "over dataset": partial(over_dataset, stored=stored)}
    found = [evaluation for run in results for evaluation in run.evaluations.values()]
    return {
        name: score
        for name, score in scores.items()
        if any(score(evaluation) is not None for evaluation in found)
    }
