"""One number per seed in, what may be said across seeds out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcmrl_data import TrainingError

FEWEST_SEEDS = 5
"""Below this many, the seeds themselves say more than an interval would."""
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Summary:
    """A quantity across seeds.

    Attributes:
        values: one per seed, in the order given.
        mean: of all.
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
    from scipy import stats

    array = np.array(values, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all():
        raise TrainingError(f"only finite values of one or more seeds can be summarised, not {list(values)}")
    low, high = mean_interval(array.tolist()) or (None, None)
    return Summary(
        values=tuple(array.tolist()),
        mean=float(array.mean()),
        iqm=float(stats.trim_mean(array, 0.25)),
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
    from scipy import stats

    if len(differences) < FEWEST_SEEDS:
        return None
    mean, error = float(np.mean(differences)), float(stats.sem(differences))
    if error == 0:
        return 1.0 if mean == 0 else 0.0
    return float(2 * stats.t.sf(abs(mean) / error, len(differences) - 1))


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
    from scipy import stats

    if len(values) < fewest:
        return None
    mean, error = float(np.mean(values)), float(stats.sem(values))
    reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1)) * error
    return mean - reach, mean + reach
