"""One number per seed in, what may be said across seeds out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcmrl_data import TrainingError

FEWEST_SEEDS = 5
"""Below this many, the seeds themselves say more than an interval would."""
CONFIDENCE = 0.95
RESAMPLES = 9_999


@dataclass(frozen=True)
class Summary:
    """A quantity across seeds.

    Attributes:
        values: one per seed, in the order given.
        mean: of all.
        iqm: interquartile mean: of what is left without the lowest and the highest quarter, rounded down.
        low, high: 95% bootstrap interval of the mean (paper, section 5.2), None under FEWEST_SEEDS.
    """

    values: tuple[float, ...]
    mean: float
    iqm: float
    low: float | None
    high: float | None

    def __str__(self) -> str:
        """Mean and interval, or mean and seeds where there are too few for an interval."""
        if self.low is None or self.high is None:
            return f"{self.mean:.3g} (seeds: {', '.join(f'{each:.3g}' for each in self.values)})"
        return f"{self.mean:.3g} [{self.low:.3g}, {self.high:.3g}]"


def summarize(values: Sequence[float]) -> Summary:
    """Mean, interquartile mean and 95% bootstrap interval of one value per seed.

    The interval is the percentile bootstrap of the mean, its resamples drawn from a fixed generator, so that
    equal values give an equal interval.

    Raises:
        TrainingError: no value, or one that is not finite.

    Example:
        >>> str(summarize([1.0, 2.0, 6.0]))
        '3 (seeds: 1, 2, 6)'
    """
    from scipy import stats

    array = np.array(values, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all():
        raise TrainingError(f"only finite values of one or more seeds can be summarised, not {list(values)}")
    low = high = None
    if array.size >= FEWEST_SEEDS:
        interval = stats.bootstrap(
            (array,),
            np.mean,
            confidence_level=CONFIDENCE,
            n_resamples=RESAMPLES,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
        low, high = float(interval.low), float(interval.high)
    return Summary(
        values=tuple(array.tolist()),
        mean=float(array.mean()),
        iqm=float(stats.trim_mean(array, 0.25)),
        low=low,
        high=high,
    )
