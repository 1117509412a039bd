"""Trajectory quality and tiers of every part, from the tables alone, and aggregates over tasks."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import SPLITS, summarize_returns
from tcmrl_data.dataset.selection import TIERS, Tier, task_scores, tier_parts
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import Record
from tcmrl_data.quality import measured
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = npt.NDArray[np.floating]

FEWEST = 5
"""Below this many values, the values themselves say more than an interval would."""

RESAMPLES, ENDS = 2_000, (0.025, 0.975)


class Spread(Record):
    """A quantity over several tasks.

    Attributes:
        iqm: interquartile mean, without the lowest and the highest quarter.
        low: lower end of the 95% bootstrap interval of `iqm`; None with fewer than five values.
    """

    mean: float
    iqm: float
    low: float | None
    high: float | None
    min: float
    max: float


class SnapshotQuality(measured.MeasuredPart):
    """The quality of a part.

    Attributes:
        tq: trajectory quality: 0 is as good as uniform actions, 1 as the best that is known of the task.
        tiers: the quality tiers that take the part.
    """

    episodes: int
    mean: float
    tq: float | None
    tiers: tuple[Tier, ...]


class TaskQuality(measured.MeasuredTask):
    """The quality of a task's parts."""

    snapshots: tuple[SnapshotQuality, ...]


class StageQuality(measured.MeasuredStage):
    """The quality of a stage's parts, whose number is `parts`; `tq` is None where a part has none."""

    parts: int
    tq: Spread | None


class Quality(measured.Measured):
    """Trajectory quality and tiers of all parts: the document of `inspect quality --json`."""

    stages: tuple[StageQuality, ...]
    tasks: tuple[TaskQuality, ...]


def measure_quality(dataset: Dataset) -> Quality:
    """Trajectory quality (TQ) and tiers of every part of a dataset.

    TQ is the mean return of a part, where 0 is the return of uniform actions and 1 the best return that is
    known of the task: that of its oracle, else of its scripted expert, else of its best snapshot.
    Source: Schweighofer et al., arXiv 2111.04714, section 3; there, 1 is the best policy found online.

    Example:
        >>> measure_quality(open_dataset("data/point-robot")).stages[-1].tq.iqm  # doctest: +SKIP
        0.9
    """
    tasks = tuple(_task_quality(dataset, task) for task in dataset.tasks)
    rows = measured.by_stage((task.split, row) for task in tasks for row in task.snapshots)
    return Quality(**measured.heading(dataset), stages=tuple(_stage(*stage) for stage in rows), tasks=tasks)


def trajectory_quality(dataset: Dataset, task: int) -> dict[PartKey, float]:
    """TQ of the parts of a task; empty where it has no reference returns, or none above uniform actions."""
    try:
        return {key: score / 100 for key, score in task_scores(dataset, task).items()}
    except SelectionError:
        return {}


def _task_quality(dataset: Dataset, task: Task) -> TaskQuality:
    qualities = trajectory_quality(dataset, task.index)
    takers = {tier: _tier_parts(dataset, task.index, tier) for tier in TIERS}
    snapshots = tuple(
        SnapshotQuality(
            step=entry.step,
            run=entry.run,
            episodes=entry.episodes,
            mean=entry.mean,
            tq=qualities.get(entry.key),
            tiers=tuple(tier for tier in TIERS if entry.key in takers[tier]),
        )
        for entry in dataset.parts.entries_of(task.index)
    )
    return TaskQuality(task=task.index, split=task.split, snapshots=snapshots)


def _tier_parts(dataset: Dataset, task: int, tier: Tier) -> set[PartKey]:
    try:
        return set(tier_parts(dataset, task, tier))
    except SelectionError:  # the task has no such snapshot, or no reference returns
        return set()


def _stage(step: int, split: Split, rows: Sequence[SnapshotQuality]) -> StageQuality:
    values = [row.tq for row in rows if row.tq is not None]
    tq = spread(values) if len(values) == len(rows) else None
    return StageQuality(step=step, split=split, parts=len(rows), tq=tq)


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


def plot_quality(found: Quality, file: Path) -> None:
    """Draws trajectory quality by step: a thin line per task, and the interquartile mean of each split."""
    figure = measured.new_figure(7.0, 4.2)
    axes = figure.subplots()
    for task in found.tasks:
        points = [(row.step, row.tq) for row in task.snapshots if row.tq is not None]
        steps, values = zip(*points, strict=True) if points else ((), ())
        axes.plot(steps, values, color=measured.COLORS[task.split], alpha=0.3, linewidth=0.8)
    for split in measured.COLORS:
        _draw_split(axes, found, split)
    for level in (0.0, 1.0):
        axes.axhline(level, color="0.3", linestyle=":", linewidth=0.9)
    measured.label_axes(axes, measured.title(found), measured.STEPS_LABEL, measured.TQ_LABEL)
    axes.legend(fontsize="small")
    measured.save_figure(figure, file)


def _draw_split(axes: "Axes", found: Quality, split: Split) -> None:
    stages = [(stage.step, stage.tq) for stage in found.stages if stage.split == split and stage.tq]
    if not stages:
        return
    steps, spreads = zip(*stages, strict=True)
    label = f"{split}, interquartile mean and 95%"
    axes.plot(steps, [tq.iqm for tq in spreads], "o-", color=measured.COLORS[split], label=label)
    if all(tq.low is not None for tq in spreads):
        ends = ([tq.low for tq in spreads], [tq.high for tq in spreads])
        axes.fill_between(steps, *ends, color=measured.COLORS[split], alpha=0.25, linewidth=0)


def plot_returns(dataset: Dataset, table: dict[str, Any], file: Path) -> None:
    """Draws the learning curves of all tasks, train and test apart, with oracle and uniform actions.

    Args:
        file: the picture to write; its ending names the format.

    Raises:
        SelectionError: the file's name is none of a picture, or the dataset has no parts.
    """
    measured.check_picture(file)
    if not any(task["snapshots"] for task in table["tasks"]):
        raise SelectionError(f"{dataset.path} has no parts to plot; build it with `tcmrl-data build`")
    figure = measured.new_figure(7.0, 4.2)
    axes = figure.subplots()
    for split, color in zip(SPLITS, ("tab:blue", "tab:orange"), strict=True):
        _draw_returns(axes, table, split, color)
    _draw_references(axes, dataset)
    axes.set(xlabel="environment steps of behavior training", ylabel="mean undiscounted return")
    axes.set_title(f"{dataset.name}: behavior policies of {len(table['tasks'])} tasks")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    measured.save_figure(figure, file)


def _draw_returns(axes: "Axes", table: dict[str, Any], split: str, color: str) -> None:
    tasks = [task for task in table["tasks"] if task["split"] == split and task["snapshots"]]
    for task in tasks:
        steps = [found["step"] for found in task["snapshots"]]
        axes.plot(
            steps, [found["mean"] for found in task["snapshots"]], color=color, alpha=0.35, linewidth=0.9
        )
    rows = [row for row in summarize_returns(table) if row["split"] == split]
    if rows:
        label = f"{split}, mean of {len(tasks)} tasks"
        axes.plot(
            [row["step"] for row in rows], [row["mean"] for row in rows], "o-", color=color, label=label
        )


def _draw_references(axes: "Axes", dataset: Dataset) -> None:
    references = [dataset.references(task.index) for task in dataset.tasks if not dataset.missing(task.index)]
    for name, line in (("oracle", "--"), ("uniform", ":")):
        values = [value for record in references if (value := getattr(record, name)) is not None]
        if values:
            axes.axhline(
                float(np.mean(values)), color="0.3", linestyle=line, label=f"{name}, mean of all tasks"
            )
