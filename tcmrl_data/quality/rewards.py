"""Stored rewards: how they are distributed, and how often there is none."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.base import Split
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.quality import measured
from tcmrl_data.store.tables import PartKey

BINS = 40
"""Default number of bins."""

Counts = npt.NDArray[np.int64]


class SnapshotRewards(measured.MeasuredPart):
    """The stored rewards of a part.

    Attributes:
        zero: share of rewards that are exactly zero.
        silent: share of episodes in which all rewards are zero.
        std: the population's.
    """

    steps: int
    zero: float
    silent: float
    mean: float
    std: float
    min: float
    max: float


class TaskRewards(measured.MeasuredTask):
    """The rewards of a task's parts."""

    snapshots: tuple[SnapshotRewards, ...]


class StageRewards(measured.MeasuredStage):
    """The rewards of a stage; `zero`, `silent`, `mean` are means over its parts."""

    parts: int
    steps: int
    zero: float
    silent: float
    mean: float
    min: float
    max: float
    counts: tuple[int, ...]


class Rewards(measured.Measured):
    """Stored rewards of all parts: the document of `inspect rewards --json`.

    Attributes:
        edges: borders of the bins, one more than bins. The first and the last bin also count what lies
            beyond, because the borders come from a sample of the parts.
    """

    edges: tuple[float, ...]
    stages: tuple[StageRewards, ...]
    tasks: tuple[TaskRewards, ...]


def measure_rewards(
    dataset: Dataset, *, bins: int = BINS, progress: Callable[[int, int], None] | None = None
) -> Rewards:
    """Histograms of stored rewards by step and split, and the share of zero rewards in every part.

    Args:
        dataset: one part at a time is in memory.

    Raises:
        SelectionError: no part has steps, or there would be no bin.
        StoreError: a part is damaged.
    """
    if bins < 1:
        raise SelectionError(f"bins {bins} is not a positive number")
    edges = _edges([steps.rewards for steps in measured.sampled_parts(dataset)], bins)
    counts, rows = dict[tuple[int, Split], Counts](), []
    for task, parts in measured.steps_by_task(dataset, progress):
        snapshots = []
        for key, steps in parts:
            snapshots.append(_snapshot(key, steps))
            inside = np.clip(steps.rewards, edges[0], edges[-1])
            found = np.histogram(inside, edges)[0].astype(np.int64)
            counts[key.step, task.split] = counts.get((key.step, task.split), 0) + found
        rows.append(TaskRewards(task=task.index, split=task.split, snapshots=tuple(snapshots)))
    stages = measured.by_stage((task.split, row) for task in rows for row in task.snapshots)
    return Rewards(
        **measured.heading(dataset),
        edges=tuple(edges.tolist()),
        stages=tuple(_stage(step, split, members, counts[step, split]) for step, split, members in stages),
        tasks=tuple(rows),
    )


def _edges(samples: list[FloatArray], bins: int) -> FloatArray:
    """Borders of bins from the smallest to the largest reward; a single value gets bins around it."""
    low, high = min(rewards.min() for rewards in samples), max(rewards.max() for rewards in samples)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, bins + 1)


def _snapshot(key: PartKey, steps: measured.PartSteps) -> SnapshotRewards:
    rewards = steps.rewards
    ends = np.cumsum(steps.lengths)[:-1]
    silent = [not episode.any() for episode in np.split(rewards, ends)]
    return SnapshotRewards(
        step=key.step,
        run=key.run,
        steps=len(rewards),
        zero=float(np.mean(rewards == 0)),
        silent=fmean(silent),
        mean=float(rewards.mean()),
        std=float(rewards.std()),
        min=float(rewards.min()),
        max=float(rewards.max()),
    )


def _stage(step: int, split: Split, rows: Sequence[SnapshotRewards], counts: Counts) -> StageRewards:
    return StageRewards(
        step=step,
        split=split,
        parts=len(rows),
        steps=sum(row.steps for row in rows),
        zero=fmean(row.zero for row in rows),
        silent=fmean(row.silent for row in rows),
        mean=fmean(row.mean for row in rows),
        min=min(row.min for row in rows),
        max=max(row.max for row in rows),
        counts=tuple(counts.tolist()),
    )


def plot_rewards(found: Rewards, file: Path) -> None:
    """Draws the distribution of rewards by step, training tasks, and the share of zero rewards."""
    figure = measured.new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2)
    stages = [stage for stage in found.stages if stage.split == "train"] or list(found.stages)
    shares = [[count / max(1, sum(stage.counts)) for count in stage.counts] for stage in stages]
    image = left.imshow(
        list(zip(*shares, strict=True)),
        aspect="auto",
        origin="lower",
        extent=(-0.5, len(stages) - 0.5, found.edges[0], found.edges[-1]),
        norm="log" if any(map(any, shares)) else None,
    )
    left.set_xticks(
        range(len(stages)), [f"{stage.step:,}" for stage in stages], rotation=60, fontsize="small"
    )
    left.set(
        title=f"{measured.title(found)}: rewards, {stages[0].split} tasks",
        xlabel=measured.STEPS_LABEL,
        ylabel="reward",
    )
    left.figure.colorbar(image, ax=left, label="share of steps in a bin")
    for split, color in measured.COLORS.items():
        rows = [stage for stage in found.stages if stage.split == split]
        steps = [stage.step for stage in rows]
        right.plot(steps, [stage.zero for stage in rows], "o-", color=color, label=f"{split}, zero rewards")
        right.plot(
            steps,
            [stage.silent for stage in rows],
            "s--",
            color=color,
            label=f"{split}, episodes without reward",
        )
    right.set_ylim(-0.03, 1.03)
    measured.label_axes(right, "how often there is no reward", measured.STEPS_LABEL, "share")
    right.legend(fontsize="small")
    measured.save_figure(figure, file)
