"""Coverage of states and actions, and stored rewards, of episodes whose numbers are known."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Dataset, SelectionError, Trajectory, measure_coverage, measure_rewards
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.quality.coverage import Grid
from tcmrl_data.quality.measured import PartSteps, read_steps
from tcmrl_data.store.tables import PartKey
from tests.commands import Call
from tests.graded import graded_dataset, made_dataset


def episode(positions: Sequence[float], rewards: Sequence[float] = ()) -> Trajectory:
    """Steps from the given positions on an axis, with actions 0; the last one is observed twice."""
    steps = len(positions)
    observations = np.zeros((steps + 1, 2), dtype=np.float32)
    observations[:steps, 0] = positions
    observations[steps, 0] = positions[-1]
    return Trajectory(
        observations,
        np.zeros((steps, 2), dtype=np.float32),
        np.array(rewards or [-1.0] * steps, dtype=np.float32),
        np.zeros(steps, dtype=bool),
        np.arange(steps) == steps - 1,
    )


def test_cells_are_counted_once_and_do_not_straddle_zero() -> None:
    columns = np.array([0])
    grid = Grid(np.array([1.0]), np.array([0.5]), columns, columns)
    observations = np.array([[0.2], [0.7], [1.1], [-0.1]])
    steps = PartSteps(observations, np.array([[0.1], [0.6], [0.1], [0.1]]), np.zeros(4), observations, (4,))
    assert len(grid.states(steps)) == 3  # [0, 1) twice, [1, 2), [-1, 0)
    assert len(grid.pairs(steps)) == 4  # the actions tell the first two apart
    assert grid.columns == 2


def test_coverage_is_the_share_of_a_tasks_cells_that_a_part_visits(tmp_path: Path) -> None:
    """Task 0 is at 1 and -1, then at 1 alone; task 1 is at -1 alone. Nothing but the position varies."""
    both, right, left = [1.0, -1.0, 1.0, -1.0], [1.0] * 4, [-1.0] * 4
    parts = {
        PartKey(0, 0): [episode(both)],
        PartKey(0, 5): [episode(right)],
        PartKey(1, 0): [episode(left)],
        PartKey(1, 5): [episode(left)],
    }
    seen = []
    dataset = made_dataset(tmp_path / "made", parts)
    found = measure_coverage(dataset, progress=lambda done, total: seen.append((done, total)))
    assert found.columns == 1
    first, second = found.tasks
    assert [(row.cells, row.saco, row.steps) for row in first.snapshots] == [(2, 1.0, 4), (1, 0.5, 4)]
    assert [(row.cells, row.saco) for row in second.snapshots] == [(1, 1.0), (1, 1.0)]
    assert [(stage.step, stage.cells, stage.saco) for stage in found.stages] == [
        (0, 1.5, 1.0),
        (5, 1.0, 0.75),
    ]
    assert found.overlap.tasks == (0, 1)
    assert found.overlap.shares == ((1.0, 0.5), (1.0, 1.0))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_smaller_cells_are_more(tiny: Dataset) -> None:
    fine, coarse = (measure_coverage(tiny, cell=cell, overlap_tasks=2) for cell in (0.1, 2.0))
    assert fine.tasks[0].cells > 3 * coarse.tasks[0].cells
    assert fine.overlap.tasks == (0, 99)
    assert fine.tasks[0].snapshots[0].tq is not None
    with pytest.raises(SelectionError, match="positive"):
        measure_coverage(tiny, cell=0.0)


def test_rewards_are_counted_by_value_and_silent_episodes_apart(tmp_path: Path) -> None:
    parts = {PartKey(0, 0): [episode([0.0, 1.0], [0.0, 0.0]), episode([0.0, 1.0, 2.0], [0.0, 4.0, 1.0])]}
    found = measure_rewards(made_dataset(tmp_path / "made", parts), bins=4)
    (row,) = found.tasks[0].snapshots
    assert (row.steps, row.zero, row.silent, row.mean, row.min, row.max) == (5, 0.6, 0.5, 1.0, 0.0, 4.0)
    assert row.std == pytest.approx(np.sqrt((3 * 1 + 9 + 0) / 5))
    assert found.edges == (0.0, 1.0, 2.0, 3.0, 4.0)
    assert found.stages[0].counts == (3, 1, 0, 1)


def test_rewards_beyond_the_sampled_range_count_in_the_outer_bins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tcmrl_data.quality.measured.SAMPLED_PARTS", 1)
    parts = {
        PartKey(0, 0): [episode([0.0, 1.0], [0.0, 2.0])],
        PartKey(0, 5): [episode([0.0, 1.0], [-9.0, 9.0])],
    }
    found = measure_rewards(made_dataset(tmp_path / "made", parts), bins=2)
    assert found.edges == (0.0, 1.0, 2.0)
    assert [stage.counts for stage in found.stages] == [(1, 1), (1, 1)]


def test_a_single_reward_gets_bins_around_it(tmp_path: Path) -> None:
    found = measure_rewards(made_dataset(tmp_path / "made", {PartKey(0, 0): [episode([0.0])]}), bins=2)
    assert (found.edges, found.stages[0].counts) == ((-1.5, -1.0, -0.5), (0, 1))


def test_steps_of_a_part_lie_side_by_side_with_what_follows(tmp_path: Path) -> None:
    parts = {PartKey(0, 0): [episode([3.0]), episode([1.0, 2.0])]}
    steps = read_steps(made_dataset(tmp_path / "made", parts), PartKey(0, 0))
    assert steps.observations[:, 0].tolist() == [3.0, 1.0, 2.0]
    assert steps.next_observations[:, 0].tolist() == [3.0, 2.0, 2.0]
    assert (steps.lengths, len(steps)) == ((1, 2), 3)


def test_values_that_are_not_finite_are_refused_with_their_file(tmp_path: Path) -> None:
    parts = {PartKey(0, 0): [episode([0.0, np.inf])]}
    with pytest.raises((StoreError, SelectionError), match="not finite"):
        measure_coverage(made_dataset(tmp_path / "made", parts))


@pytest.mark.parametrize("what", ["coverage", "rewards"])
def test_the_command_prints_what_python_gives(call: Call, tmp_path: Path, what: str) -> None:
    dataset = graded_dataset(tmp_path / "graded")
    measure = {"coverage": measure_coverage, "rewards": measure_rewards}[what]
    picture = tmp_path / "picture.png"
    code, output, _ = call("inspect", what, dataset.folder, "--json", "--plot", picture)
    assert (code, json.loads(output)) == (0, measure(dataset).model_dump(mode="json"))
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert call("inspect", what, dataset.folder)[1].count("train") == 5
