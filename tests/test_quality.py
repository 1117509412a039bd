"""Trajectory quality and tiers of parts, and the aggregates over tasks."""

import json
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Dataset, measure_quality
from tcmrl_data.quality.scores import bootstrap_interval, interquartile_mean, spread
from tcmrl_data.store.part import References
from tests.commands import Call, assert_refused
from tests.graded import graded_dataset


def test_trajectory_quality_is_zero_for_uniform_and_one_for_oracle_returns(tmp_path: Path) -> None:
    """Uniform actions get 0 and the oracle 10: means of 0, 2, 4, 9, 8 are TQs of 0, 0.2, 0.4, 0.9, 0.8."""
    found = measure_quality(graded_dataset(tmp_path / "graded"))
    assert [task.split for task in found.tasks] == ["train", "train", "train", "test"]
    for task in found.tasks:
        assert [row.step for row in task.snapshots] == [0, 100, 200, 300, 400]
        assert [row.tq for row in task.snapshots] == pytest.approx([0.0, 0.2, 0.4, 0.9, 0.8])
        assert ["medium" in row.tiers for row in task.snapshots] == [False, False, True, False, False]
        assert ["expert" in row.tiers for row in task.snapshots] == [False, False, False, True, False]
        assert ["random" in row.tiers for row in task.snapshots] == [True, False, False, False, False]
    assert [(stage.step, stage.split, stage.parts) for stage in found.stages[:3]] == [
        (0, "train", 3),
        (0, "test", 1),
        (100, "train", 3),
    ]
    last = found.stages[-2].tq
    assert last is not None
    assert (last.mean, last.iqm, last.min, last.max) == pytest.approx((0.8, 0.8, 0.8, 0.8))
    assert (last.low, last.high) == (None, None)


def test_without_an_oracle_the_best_snapshot_is_one(tmp_path: Path) -> None:
    """Means of 0 and 6 against uniform -2: TQ 2/8 and 1."""
    references = References(uniform=-2.0, oracle=None, scripted=None)
    found = measure_quality(
        graded_dataset(tmp_path / "graded", scores={0: 0.0, 5: 60.0}, references=references)
    )
    assert [row.tq for row in found.tasks[0].snapshots] == pytest.approx([0.25, 1.0])


def test_without_reference_returns_there_is_no_trajectory_quality(tmp_path: Path) -> None:
    references = References(uniform=None, oracle=None, scripted=None)
    found = measure_quality(graded_dataset(tmp_path / "graded", references=references))
    assert {row.tq for task in found.tasks for row in task.snapshots} == {None}
    assert {stage.tq for stage in found.stages} == {None}
    assert {row.tiers for task in found.tasks for row in task.snapshots if row.step} == {("mixed",)}


def test_the_interquartile_mean_leaves_out_the_outer_quarters() -> None:
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, -50.0])) == pytest.approx(1.5)
    assert interquartile_mean(np.array([[3.0], [7.0]])) == pytest.approx([3.0, 7.0])
    eight = np.array([100.0, 100.0, 1.0, 2.0, 3.0, 6.0, -100.0, -100.0])
    assert spread(eight.tolist()).iqm == pytest.approx(3.0)


def test_the_bootstrap_interval_covers_the_middle_of_resamples() -> None:
    """The mean of n fair coins, resampled, has a standard deviation of 0.5 / sqrt(n): 0.05 for 100."""
    coins = np.array([0.0, 1.0] * 50)
    low, high = bootstrap_interval(100, lambda resamples: coins[resamples].mean(axis=1))
    assert low == pytest.approx(0.5 - 1.96 * 0.05, abs=0.01)
    assert high == pytest.approx(0.5 + 1.96 * 0.05, abs=0.01)
    assert bootstrap_interval(4, lambda resamples: coins[resamples].mean(axis=1)) == (None, None)


def test_inspect_quality_prints_what_python_gives(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    picture = tmp_path / "quality.svg"
    code, output, _ = call("inspect", "quality", tiny.folder, "--json", "--plot", picture)
    assert (code, json.loads(output)) == (0, measure_quality(tiny).model_dump(mode="json"))
    assert b"<svg" in picture.read_bytes()[:1000]
    output = call("inspect", "quality", tiny.folder)[1]
    assert "random 4" in output and "random 1" in output
    wrong = tmp_path / "quality.gif"
    assert_refused(call("inspect", "quality", tiny.folder, "--plot", wrong), "gif", ".png")
