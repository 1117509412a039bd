"""State-action coverage of parts, and how far tasks visit the same states.

Observations and actions are counted in cells of a fixed grid, whose width is a multiple of the dataset's
standard deviation of every column. With many columns nearly every step has a cell of its own; coverage then
tells little more than the number of steps.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import evenly_spread
from tcmrl_data.quality import measured
from tcmrl_data.quality.scores import trajectory_quality
from tcmrl_data.store.tables import PartKey

CELL = 0.5
"""Default width of a cell in standard deviations."""

OVERLAP_TASKS = 20
"""Tasks in the matrix of overlaps by default."""

LARGEST_CELL = 2**31 - 1

Cells = npt.NDArray[Any]
"""Distinct cells, sorted; one opaque item each."""


class SnapshotCoverage(measured.MeasuredPart):
    """The coverage of a part.

    Attributes:
        saco: `cells` as a share of the cells of all parts of the task.
        tq: trajectory quality, as in `SnapshotQuality`.
    """

    steps: int
    cells: int
    saco: float
    tq: float | None


class TaskCoverage(measured.MeasuredTask):
    """The coverage of a task's parts; `cells` counts those of all parts together."""

    cells: int
    snapshots: tuple[SnapshotCoverage, ...]


class StageCoverage(measured.MeasuredStage):
    """Means over a stage's parts."""

    parts: int
    steps: float
    cells: float
    saco: float
    tq: float | None


class Overlap(Record):
    """How far tasks visit the same states.

    Attributes:
        tasks: indices of tasks, evenly spread over the dataset's.
        shares: row i, column j: share of the state cells of task `tasks[i]` that task `tasks[j]` visits too.
    """

    tasks: tuple[int, ...]
    shares: tuple[tuple[float, ...], ...]


class Coverage(measured.Measured):
    """State-action coverage of all parts: the document of `inspect coverage --json`.

    Attributes:
        cell: width of a cell in standard deviations of each column.
        columns: number of observation and action columns that vary; the grid has as many dimensions.
    """

    cell: float
    columns: int
    stages: tuple[StageCoverage, ...]
    tasks: tuple[TaskCoverage, ...]
    overlap: Overlap


def measure_coverage(
    dataset: Dataset,
    *,
    cell: float = CELL,
    overlap_tasks: int = OVERLAP_TASKS,
    progress: Callable[[int, int], None] | None = None,
) -> Coverage:
    """State-action coverage (SACo) of every part beside its trajectory quality.

    SACo is the number of different state-action pairs of a dataset, as a share of those of a reference
    dataset. Source: Schweighofer et al., arXiv 2111.04714, whose reference is the replay buffer of a learner.
    Here pairs are cells, a dataset is a part, and the reference is all parts of its task together.

    Args:
        dataset: one part at a time is in memory.
        cell: width of a cell in standard deviations.
        overlap_tasks: number of tasks in the matrix of overlaps.

    Raises:
        SelectionError: no part has steps, or `cell` is not positive.
        StoreError: a part is damaged.

    Example:
        >>> measure_coverage(open_dataset("data/point-robot")).stages[0].saco  # doctest: +SKIP
        0.3
    """
    if not 0 < cell < np.inf:
        raise SelectionError(f"cell {cell} is not a positive number of standard deviations")
    grid = _grid(measured.sampled_parts(dataset), cell)
    tasks = list(dict.fromkeys(key.task for key in measured.filled_parts(dataset)))
    compared = evenly_spread(tasks, overlap_tasks)
    rows, visited = [], dict[int, Cells]()
    for task, parts in measured.steps_by_task(dataset, progress):
        pairs, states = dict[PartKey, Cells](), grid.no_states
        for key, steps in parts:
            pairs[key] = grid.pairs(steps)
            if task.index in compared:
                states = np.union1d(states, grid.states(steps))
        rows.append(_task_coverage(dataset, task, pairs))
        if task.index in compared:
            visited[task.index] = states
    stages = measured.by_stage((task.split, row) for task in rows for row in task.snapshots)
    return Coverage(
        **measured.heading(dataset),
        cell=cell,
        columns=grid.columns,
        stages=tuple(_stage(*stage) for stage in stages),
        tasks=tuple(rows),
        overlap=_overlap(visited),
    )


@dataclass(frozen=True)
class Grid:
    """A grid over the columns of observations and actions that vary: their positions and widths of cells."""

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

    def states(self, steps: measured.PartSteps) -> Cells:
        """Distinct cells of observations."""
        return _distinct(steps.observations[:, self.observation_columns] / self.observation_widths)

    def pairs(self, steps: measured.PartSteps) -> Cells:
        """Distinct cells of observations with actions."""
        observations = steps.observations[:, self.observation_columns] / self.observation_widths
        actions = steps.actions[:, self.action_columns] / self.action_widths
        return _distinct(np.concatenate([observations, actions], axis=1))


def _grid(sample: Iterable[measured.PartSteps], cell: float) -> Grid:
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
        columns[name] = np.flatnonzero(std > measured.SMALLEST_STD)
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


def _stage(step: int, split: Split, rows: Sequence[SnapshotCoverage]) -> StageCoverage:
    known = [row.tq for row in rows if row.tq is not None]
    return StageCoverage(
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


def plot_coverage(found: Coverage, file: Path) -> None:
    """Draws coverage against trajectory quality, a line per split along the steps, and overlaps of tasks."""
    figure = measured.new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2)
    for split, color in measured.COLORS.items():
        parts = [row for task in found.tasks if task.split == split for row in task.snapshots]
        known = [(row.saco, row.tq) for row in parts if row.tq is not None]
        if known:
            left.scatter(*zip(*known, strict=True), s=5, alpha=0.25, color=color, linewidths=0)
        stages = [stage for stage in found.stages if stage.split == split and stage.tq is not None]
        saco, tq = [stage.saco for stage in stages], [stage.tq for stage in stages]
        left.plot(saco, tq, "o-", color=color, label=f"{split}, means by step", markersize=4)
        for stage in stages[:: max(1, len(stages) - 1)] if split == "train" else ():
            place = (stage.saco, stage.tq or 0.0)
            left.annotate(f"step {stage.step:,}", place, (6, 6), textcoords="offset points", fontsize="small")
    measured.label_axes(
        left, measured.title(found), "state-action coverage (share of the task's cells)", measured.TQ_LABEL
    )
    left.legend(fontsize="small")
    measured.draw_matrix(right, found.overlap.shares, found.overlap.tasks, "share of states visited too")
    right.set(title="states that tasks share", xlabel="task", ylabel="task")
    measured.save_figure(figure, file)
