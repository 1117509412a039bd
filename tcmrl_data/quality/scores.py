"""Trajectory quality and tiers of every part, from the tables alone; no part is opened."""

from collections.abc import Iterable

from tcmrl_data.dataset.tables import Tables
from tcmrl_data.dataset.tiers import TIERS, Tier, task_scores, tier_parts
from tcmrl_data.envs.tasks import Split, Task
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.quality.aggregates import spread
from tcmrl_data.quality.records import Quality, SnapshotQuality, StageQuality, TaskQuality, heading
from tcmrl_data.store.keys import PartKey

SPLITS: tuple[Split, ...] = ("train", "test")


def measure_quality(dataset: Tables) -> Quality:
    """Trajectory quality (TQ) and tiers of every part of a dataset.

    TQ is the mean return of a part, where 0 is the return of uniform actions and 1 the best return that is
    known of the task: that of its oracle, else of its scripted expert, else of its best snapshot.
    Source: Schweighofer et al., arXiv 2111.04714, section 3; there, 1 is the best policy found online.

    Example:
        >>> measure_quality(open_dataset("data/point-robot")).stages[-1].tq.iqm  # doctest: +SKIP
        0.9
    """
    tasks = tuple(_task_quality(dataset, task) for task in dataset.tasks)
    return Quality(**heading(dataset), stages=tuple(_stages(tasks)), tasks=tasks)


def trajectory_quality(dataset: Tables, task: int) -> dict[PartKey, float]:
    """TQ of the parts of a task; empty where it has no reference returns, or none above uniform actions."""
    try:
        return {key: score / 100 for key, score in task_scores(dataset, task).items()}
    except SelectionError:
        return {}


def _task_quality(dataset: Tables, task: Task) -> TaskQuality:
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


def _tier_parts(dataset: Tables, task: int, tier: Tier) -> set[PartKey]:
    try:
        return set(tier_parts(dataset, task, tier))
    except SelectionError:  # the task has no such snapshot, or no reference returns
        return set()


def _stages(tasks: Iterable[TaskQuality]) -> Iterable[StageQuality]:
    found: dict[tuple[int, Split], list[float | None]] = {}
    for task in tasks:
        for snapshot in task.snapshots:
            found.setdefault((snapshot.step, task.split), []).append(snapshot.tq)
    for step, split in in_stage_order(found):
        values = [value for value in found[step, split] if value is not None]
        parts = len(found[step, split])
        tq = spread(values) if len(values) == parts else None
        yield StageQuality(step=step, split=split, parts=parts, tq=tq)


def in_stage_order(stages: Iterable[tuple[int, Split]]) -> list[tuple[int, Split]]:
    """Steps and splits ascending by step, training before test."""
    return sorted(stages, key=lambda stage: (stage[0], SPLITS.index(stage[1])))
