"""Forecasts: what a build makes, and how long it takes by measured updates."""

import itertools

import pytest

import tcmrl_data
from tcmrl_data.building import forecast
from tcmrl_data.building.forecast import Measurement, makespan, task_seconds
from tests.conftest import TINY


@pytest.mark.parametrize("name", ["sac", "stacked"])
def test_a_probe_shortens_the_warm_up_and_nothing_else(name: str) -> None:
    recipe = tcmrl_data.load_recipe("half-cheetah-vel", overrides=[f"behavior.source={name}"])
    source = recipe.make_source()
    short = source.with_warmup(200)
    assert (source.warmup_steps, short.warmup_steps) == (2_000, 200)
    assert short.with_warmup(2_000).warmup_steps == 200
    assert (short.steps, short.training_steps, short.group_size) == (
        source.steps,
        source.training_steps,
        source.group_size,
    )


def test_the_probes_clock_parts_warm_up_from_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of 0.01 s until 200 are done, a report while libraries initialise, then 1 s and 3 s."""
    now = itertools.accumulate([0.0] + [0.2] * 10 + [500.0, 20.0, 60.0])
    monkeypatch.setattr(forecast.time, "monotonic", lambda: next(now))
    clock = forecast.Clock(200)
    for _ in range(12):
        clock.report(20)
    with pytest.raises(forecast.ProbeOverError):
        clock.report(20)
    found = clock.measured()
    assert found["warmup"] == pytest.approx(0.01)
    assert found["updates"] == pytest.approx([1.0, 3.0])


def test_a_task_takes_its_warm_up_its_updates_and_its_parts() -> None:
    recipe = tcmrl_data.load_recipe("point-robot", profile="quick", overrides=TINY)
    found = [Measurement(2.0, 1.0, warmup, (0.1,), 3.0, 1.0, 1.0) for warmup in (0.01, 0.03)]
    seconds = task_seconds(recipe.make_source(), found, update=0.1, stretch=2.0)
    assert seconds == pytest.approx(50 * 0.02 + 100 * 0.1 + 2 * (3.0 + 2 * 1.0))


@pytest.mark.parametrize(
    ("units", "workers", "expected"),
    [([5.0], 2, 5.0), ([1.0, 5.0, 4.0], 1, 10.0), ([1.0, 5.0, 4.0], 2, 5.0), ([3.0] * 3, 2, 6.0)],
)
def test_the_longest_units_start_first(units: list[float], workers: int, expected: float) -> None:
    assert makespan(units, workers) == expected


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
