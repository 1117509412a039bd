"""Numbers over several tasks: interquartile means and bootstrap intervals."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from tcmrl_data.quality.records import Spread

FloatArray = npt.NDArray[np.floating]

FEWEST = 5
"""Below this many values, the values themselves say more than an interval would."""

RESAMPLES, ENDS = 2_000, (0.025, 0.975)


def interquartile_mean(values: FloatArray) -> FloatArray:
    """Mean along the last axis without the lowest and the highest quarter, sizes rounded down.

    Source: Agarwal et al. (arXiv 2108.13264, section 4.3) recommend it beside the mean.
    """
    cut = values.shape[-1] // 4
    kept = np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut]
    mean: FloatArray = kept.mean(axis=-1)
    return mean


def bootstrap_interval(
    count: int, statistic: Callable[[npt.NDArray[np.intp]], FloatArray]
) -> tuple[float | None, float | None]:
    """The 95% percentile bootstrap interval of a statistic; None for both ends with fewer than FEWEST values.

    Args:
        count: number of values.
        statistic: of resamples (resamples, count), which hold positions of values.
    """
    if count < FEWEST:
        return None, None
    resamples = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    low, high = np.quantile(statistic(resamples), ENDS)
    return (float(low), float(high)) if np.isfinite([low, high]).all() else (None, None)


def spread(values: Sequence[float]) -> Spread:
    """Mean, interquartile mean with its interval, and range of at least one value."""
    array = np.array(values, dtype=np.float64)
    low, high = bootstrap_interval(len(array), lambda resamples: interquartile_mean(array[resamples]))
    return Spread(
        mean=float(array.mean()),
        iqm=float(interquartile_mean(array)),
        low=low,
        high=high,
        min=float(array.min()),
        max=float(array.max()),
    )
