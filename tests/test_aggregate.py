"""Statistics and verdicts across seeds."""

import numpy as np
import pytest

from tcmrl_algo import summarize
from tcmrl_algo.report.statistics import holm, mean_interval, sign_probability
from tcmrl_data import TrainingError


def test_fewer_than_five_seeds_get_no_interval_but_stand_there() -> None:
    found = summarize([1.0, 2.0, 6.0, 3.0])
    assert (found.low, found.high) == (None, None)
    assert (found.mean, found.iqm) == (3.0, 2.5)  # without 1 and 6
    assert mean_interval(found.values) is None


def test_the_interval_is_students_t_by_hand() -> None:
    """Squared deviations 16, 9, 4, 0 and 81: standard error sqrt(110 / 4 / 5); t of 4 degrees is 2.7764."""
    found = summarize([0.0, 1.0, 2.0, 4.0, 13.0])
    assert found.low == pytest.approx(4 - 2.7764 * 5.5**0.5, abs=1e-3)
    assert found.high == pytest.approx(4 + 2.7764 * 5.5**0.5, abs=1e-3)
    assert (found.mean, found.iqm) == (4.0, pytest.approx(7 / 3))
    assert mean_interval([1.0, 3.0], fewest=2) == pytest.approx((2 - 12.7062, 2 + 12.7062), abs=1e-3)


def test_a_p_value_is_below_a_twentieth_where_the_interval_excludes_zero() -> None:
    draws = np.random.default_rng(1).normal(loc=0.9, size=(200, 5)).tolist()
    excluded = [low > 0 or high < 0 for low, high in filter(None, map(mean_interval, draws))]
    assert [(sign_probability(draw) or 0) < 0.05 for draw in draws] == excluded
    assert 20 < sum(excluded) < 180
    assert sign_probability([1.0] * 4) is None
    assert (sign_probability([2.0] * 5), sign_probability([0.0] * 5)) == (0.0, 1.0)


def test_holms_correction_by_hand() -> None:
    """Smallest first: 0.005 × 4, 0.01 × 3, then 0.03 × 2 and 0.04 × 1, which is raised to the one before."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9, 0.5]) == [1.0, 1.0, 1.0]
    assert holm([]) == []


@pytest.mark.parametrize("values", [[], [1.0, float("nan")], [float("inf")] * 6])
def test_what_cannot_be_summarised_is_refused(values: list[float]) -> None:
    with pytest.raises(TrainingError, match="finite"):
        summarize(values)
