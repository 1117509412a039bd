"""State-action coverage of parts, and how far tasks visit the same states.

Observations and actions are counted in cells of a fixed grid, whose width is a multiple of the dataset's
standard deviation of every column. With many columns nearly every step has a cell of its own; coverage then
tells little more than the number of steps.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Split, Task
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.quality.records import (
    Coverage,
    Overlap,
    SnapshotCoverage,
    StageCoverage,
    TaskCoverage,
    heading,
)
from tcmrl_data.quality.scores import in_stage_order, trajectory_quality
from tcmrl_data.quality.steps import (
    PartSteps,
    Progress,
    parts_by_task,
    read_steps,
    sampled_parts,
    spread_tasks,
)
from tcmrl_data.store.keys import PartKey

CELL = 0.5
"""Default width of a cell in standard deviations."""

OVERLAP_TASKS = 20
"""Tasks in the matrix of overlaps by default."""

SMALLEST_STD = 1e-6
"""Columns whose standard deviation is smaller do not vary."""

LARGEST_CELL = 2**31 - 1

Cells = npt.NDArray[Any]
"""Distinct cells, sorted; one opaque item each."""


def measure_coverage(
    dataset: Dataset,
    *,
    cell: float = CELL,
    overlap_tasks: int = OVERLAP_TASKS,
    progress: Progress = lambda done, total: None,
) -> Coverage:
    """State-action coverage (SACo) of every part beside its trajectory quality.

    SACo is the number of different state-action pairs of a dataset, as a share of those of a reference
    dataset. Source: Schweighofer et al., arXiv 2111.04714, whose reference is the replay buffer of a learner.
    Here pairs are cells, a dataset is a part, and the reference is all parts of its task together.

    Args:
        dataset: the dataset; one part at a time is in memory.
        cell: width of a cell in standard deviations.
        overlap_tasks: number of tasks in the matrix of overlaps.
        progress: called with parts done and parts in all.

    Raises:
        SelectionError: no part has steps, or `cell` is not positive.
        StoreError: a part is damaged.

    Example:
        >>> measure_coverage(open_dataset("data/point-robot")).stages[0].saco  # doctest: +SKIP
        0.3
    """
    if not 0 < cell < np.inf:
        raise SelectionError(f"--cell {cell} is not a positive number of standard deviations")
    grid = _grid(sampled_parts(dataset), cell)
    tasks = parts_by_task(dataset)
    total, done = sum(len(keys) for _, keys in tasks), 0
    compared = {task.index for task in spread_tasks([task for task, _ in tasks], overlap_tasks)}
    rows, visited = [], dict[int, Cells]()
    for task, keys in tasks:
        pairs, states = dict[PartKey, Cells](), grid.no_states
        for key in keys:
            steps = read_steps(dataset, key)
            pairs[key] = grid.pairs(steps)
            if task.index in compared:
                states = np.union1d(states, grid.states(steps))
            done += 1
            progress(done, total)
        rows.append(_task_coverage(dataset, task, pairs))
        if task.index in compared:
            visited[task.index] = states
    return Coverage(
        **heading(dataset),
        cell=cell,
        columns=grid.columns,
        stages=tuple(_stages(rows)),
        tasks=tuple(rows),
        overlap=_overlap(visited),
    )


@dataclass(frozen=True)
class Grid:
    """A grid over observations and actions.

    Attributes:
        observation_widths: (observation columns that vary,), widths of cells.
        action_widths: (action columns that vary,).
        observation_columns: positions of these columns.
        action_columns: likewise.
    """

    observation_widths: FloatArray
    action_widths: FloatArray
    observation_columns: npt.NDArray[np.intp]
    action_columns: npt.NDArray[np.intp]

    @property
    def columns(self) -> int:
        """Number of dimensions."""
        return len(self.observation_columns) + len(self.action_columns)

    @property
    def no_states(self) -> Cells:
        """No state cells."""
        return _distinct(np.empty((0, len(self.observation_columns))))

    def states(self, steps: PartSteps) -> Cells:
        """Distinct cells of observations."""
        return _distinct(steps.observations[:, self.observation_columns] / self.observation_widths)

    def pairs(self, steps: PartSteps) -> Cells:
        """Distinct cells of observations with actions."""
        observations = steps.observations[:, self.observation_columns] / self.observation_widths
        actions = steps.actions[:, self.action_columns] / self.action_widths
        return _distinct(np.concatenate([observations, actions], axis=1))


def _grid(sample: Iterable[PartSteps], cell: float) -> Grid:
    """A grid from the standard deviations of all columns over a sample of parts."""
    found: dict[str, list[FloatArray]] = {"observations": [], "actions": []}
    counts = []
    for steps in sample:
        counts.append(len(steps))
        for name, rows in found.items():
            array = getattr(steps, name)
            rows.append(np.stack([array.mean(axis=0), array.var(axis=0)]))
    widths, columns = {}, {}
    for name, rows in found.items():
        means, variances = np.stack(rows, axis=1)
        mean = np.average(means, axis=0, weights=counts)
        variance = np.average(variances + (means - mean) ** 2, axis=0, weights=counts)
        std = np.sqrt(variance)
        columns[name] = np.flatnonzero(std > SMALLEST_STD)
        widths[name] = cell * std[columns[name]]
    return Grid(widths["observations"], widths["actions"], columns["observations"], columns["actions"])


def _distinct(positions: FloatArray) -> Cells:
    """The distinct cells of positions (steps, columns), which are measured in widths of a cell."""
    if positions.shape[1] == 0:  # nothing varies: all steps are in one cell
        positions = np.zeros((len(positions), 1))
    cells = np.clip(np.floor(positions), -LARGEST_CELL, LARGEST_CELL).astype(np.int32)
    rows = np.ascontiguousarray(cells).view(np.dtype((np.void, cells.itemsize * cells.shape[1])))
    distinct: Cells = np.unique(rows[:, 0])
    return distinct


def _task_coverage(dataset: Dataset, task: Task, pairs: dict[PartKey, Cells]) -> TaskCoverage:
    qualities = trajectory_quality(dataset, task.index)
    union = len(np.unique(np.concatenate(list(pairs.values()))))
    snapshots = tuple(
        SnapshotCoverage(
            step=key.step,
            run=key.run,
            steps=dataset.entry(key).steps,
            cells=len(cells),
            saco=len(cells) / union,
            tq=qualities.get(key),
        )
        for key, cells in pairs.items()
    )
    return TaskCoverage(task=task.index, split=task.split, cells=union, snapshots=snapshots)


def _stages(tasks: Iterable[TaskCoverage]) -> Iterable[StageCoverage]:
    found: dict[tuple[int, Split], list[SnapshotCoverage]] = {}
    for task in tasks:
        for snapshot in task.snapshots:
            found.setdefault((snapshot.step, task.split), []).append(snapshot)
    for step, split in in_stage_order(found):
        rows = found[step, split]
        known = [row.tq for row in rows if row.tq is not None]
        yield StageCoverage(
            step=step,
            split=split,
            parts=len(rows),
            steps=fmean(row.steps for row in rows),
            cells=fmean(row.cells for row in rows),
            saco=fmean(row.saco for row in rows),
            tq=fmean(known) if len(known) == len(rows) else None,
        )


def _overlap(visited: dict[int, Cells]) -> Overlap:
    """Shares of common cells; `visited` holds the distinct state cells of tasks."""
    shares = tuple(
        tuple(len(np.intersect1d(mine, other, assume_unique=True)) / len(mine) for other in visited.values())
        for mine in visited.values()
    )
    return Overlap(tasks=tuple(visited), shares=shares)
