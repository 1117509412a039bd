"""Stored rewards: how they are distributed, and how often there is none."""

from collections.abc import Iterable
from statistics import fmean

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Split
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.quality.records import Rewards, SnapshotRewards, StageRewards, TaskRewards, heading
from tcmrl_data.quality.scores import in_stage_order
from tcmrl_data.quality.steps import PartSteps, Progress, parts_by_task, read_steps, sampled_parts
from tcmrl_data.store.keys import PartKey

BINS = 40
"""Default number of bins."""

Stage = tuple[int, Split]
Counts = npt.NDArray[np.int64]


def measure_rewards(
    dataset: Dataset, *, bins: int = BINS, progress: Progress = lambda done, total: None
) -> Rewards:
    """Histograms of stored rewards by step and split, and the share of zero rewards in every part.

    Args:
        dataset: the dataset; one part at a time is in memory.
        bins: number of bins, of equal width.
        progress: called with parts done and parts in all.

    Raises:
        SelectionError: no part has steps, or there would be no bin.
        StoreError: a part is damaged.
    """
    if bins < 1:
        raise SelectionError(f"--bins {bins} is not a positive number")
    edges = _edges([steps.rewards for steps in sampled_parts(dataset)], bins)
    tasks = parts_by_task(dataset)
    total, done = sum(len(keys) for _, keys in tasks), 0
    counts, rows = dict[Stage, Counts](), []
    for task, keys in tasks:
        snapshots = []
        for key in keys:
            steps = read_steps(dataset, key)
            snapshots.append(_snapshot(key, steps))
            inside = np.clip(steps.rewards, edges[0], edges[-1])
            found = np.histogram(inside, edges)[0].astype(np.int64)
            stage = (key.step, task.split)
            counts[stage] = counts.get(stage, 0) + found
            done += 1
            progress(done, total)
        rows.append(TaskRewards(task=task.index, split=task.split, snapshots=tuple(snapshots)))
    return Rewards(
        **heading(dataset),
        edges=tuple(edges.tolist()),
        stages=tuple(_stages(rows, counts)),
        tasks=tuple(rows),
    )


def _edges(samples: list[FloatArray], bins: int) -> FloatArray:
    """Borders of bins from the smallest to the largest reward; a single value gets bins around it."""
    low, high = min(rewards.min() for rewards in samples), max(rewards.max() for rewards in samples)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, bins + 1)


def _snapshot(key: PartKey, steps: PartSteps) -> SnapshotRewards:
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


def _stages(tasks: Iterable[TaskRewards], counts: dict[Stage, Counts]) -> Iterable[StageRewards]:
    found: dict[Stage, list[SnapshotRewards]] = {}
    for task in tasks:
        for snapshot in task.snapshots:
            found.setdefault((snapshot.step, task.split), []).append(snapshot)
    for step, split in in_stage_order(found):
        rows = found[step, split]
        yield StageRewards(
            step=step,
            split=split,
            parts=len(rows),
            steps=sum(row.steps for row in rows),
            zero=fmean(row.zero for row in rows),
            silent=fmean(row.silent for row in rows),
            mean=fmean(row.mean for row in rows),
            min=min(row.min for row in rows),
            max=max(row.max for row in rows),
            counts=tuple(counts[step, split].tolist()),
        )
