import pytest

import tcmrl_data
from tests.conftest import TINY


@pytest.mark.check
def test_a_forecast_counts_what_a_build_makes() -> None:
    recipe = tcmrl_data.load_recipe("point-robot", profile="quick", overrides=TINY)
    plan = tcmrl_data.plan_build(recipe, tasks=[0, 3, 4])
    forecast = tcmrl_data.forecast_build(plan, workers=2)
    assert (forecast.tasks, forecast.train, forecast.test) == (3, 2, 1)
    assert (forecast.snapshots, forecast.parts) == (3, 9)
    assert (forecast.episodes, forecast.training_steps, forecast.rollout_steps) == (54, 450, 1080)
    assert forecast.bytes == 54 * 21 * (4 * 5 + 2)
    assert 0 < forecast.seconds_low < forecast.seconds < forecast.seconds_high
