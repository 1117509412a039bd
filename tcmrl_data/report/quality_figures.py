"""Figures of the measures of a dataset's quality: scores, coverage, overlap and rewards."""

from collections.abc import Iterable
from typing import Protocol, TypeVar

import numpy as np

from tcmrl_data.dataset.returns import SPLITS
from tcmrl_data.envs.tasks import Split
from tcmrl_data.page.figures import Axis, Cells, Figure, Frame, Series
from tcmrl_data.quality.transfer import Transfer
from tcmrl_data.report.content import Content

STEPS = "environment steps of behavior training"
MOST_TICKS = 20


class Stage(Protocol):
    """What was measured of one step and split."""

    @property
    def step(self) -> int:
        """Training steps of the policies."""

    @property
    def split(self) -> Split:
        """Of the tasks."""


AnyStage = TypeVar("AnyStage", bound=Stage)


def scores(content: Content) -> Figure:
    """Trajectory quality of every shown task at every snapshot."""
    shown = {task.index for task in content.shown}
    rows = [task for task in content.quality.tasks if task.task in shown]
    steps = sorted({snapshot.step for task in rows for snapshot in task.snapshots})
    cells = np.full((len(rows), len(steps)), np.nan, np.float32)
    for row, task in enumerate(rows):
        for snapshot in reversed(task.snapshots):  # of several runs, the first is shown
            if snapshot.tq is not None:
                cells[row, steps.index(snapshot.step)] = snapshot.tq
    caption = (
        "Trajectory quality (TQ): 0 is the return of uniform actions, 1 the best that is known of the task. "
        "A row is a task, from bottom to top in the order of their indices."
    )
    columns = Axis(STEPS, ticks=ticks([f"{step:,}" for step in steps]))
    tasks = Axis("task", ticks=ticks([str(task.task) for task in rows]))
    frame = Frame("", cells=Cells(cells, "TQ", low=0.0, high=1.0))
    return Figure("scores", caption, columns, tasks, (frame,), height=460)


def coverage(content: Content) -> Figure:
    """Coverage of state-action cells beside trajectory quality, by snapshot."""
    series: list[Series] = []
    for color, split in enumerate(SPLITS):
        stages = [stage for stage in content.coverage.stages if stage.split == split]
        if stages:
            steps = np.array([stage.step for stage in stages])
            saco = np.array([stage.saco for stage in stages])
            tq = np.array([np.nan if stage.tq is None else stage.tq for stage in stages])
            series.append(Series(steps, saco, f"coverage, {split} tasks", color=color, markers=True))
            series.append(Series(steps, tq, f"TQ, {split} tasks", color=color, line="dot", markers=True))
    found = content.coverage
    caption = (
        f"Coverage (SACo): different state-action cells of a part, {found.cell:g} standard deviations wide "
        f"in {found.columns} columns, as a share of those of all parts of its task; beside the trajectory "
        "quality. Means over tasks."
    )
    return Figure("coverage", caption, Axis(STEPS), Axis("share"), (Frame("", tuple(series)),), height=360)


def overlap(content: Content) -> Figure:
    """How far tasks visit the same states."""
    found = content.coverage.overlap
    names = ticks([str(task) for task in found.tasks])
    caption = (
        "Row i, column j: share of the state cells of task i that task j visits too. Where tasks share most "
        "of their states, rewards must tell them apart."
    )
    cells = Cells(np.array(found.shares, np.float32), "share of cells", low=0.0, high=1.0)
    rows, columns = Axis("task i", ticks=names), Axis("task j", ticks=names)
    return Figure("overlap", caption, columns, rows, (Frame("", cells=cells),), is_square=True, height=460)


def transfer(found: Transfer) -> Figure:
    """What the last policy of every task scores in every task."""
    names = ticks([str(task.task) for task in found.tasks])
    scores = [value for row in found.scores for value in row if value is not None]
    is_scored = len(scores) == len(found.tasks) ** 2
    what = "score, where uniform actions have 0 and the best known return 1," if is_scored else "mean return"
    caption = (
        f"Row i, column j: {what} of the last policy of task i in task j; {found.episodes} episodes each, "
        "training tasks first. A single policy that is good everywhere is a bright row."
    )
    values = np.array(found.scores if is_scored else found.returns, np.float32)
    low, high = (0.0, 1.0) if is_scored else (float(values.min()), float(values.max()))
    cells = Cells(values, "score" if is_scored else "return", low=low, high=high)
    rows, columns = Axis("policy of task i", ticks=names), Axis("task j", ticks=names)
    return Figure("transfer", caption, columns, rows, (Frame("", cells=cells),), is_square=True, height=460)


def silence(content: Content) -> Figure:
    """Share of zero rewards and of episodes without any reward, by snapshot."""
    series: list[Series] = []
    for color, split in enumerate(SPLITS):
        stages = [stage for stage in content.rewards.stages if stage.split == split]
        if stages:
            steps = np.array([stage.step for stage in stages])
            zero, silent = (
                np.array([getattr(stage, name) for stage in stages]) for name in ("zero", "silent")
            )
            series.append(Series(steps, zero, f"zero rewards, {split} tasks", color=color, markers=True))
            name = f"episodes without reward, {split} tasks"
            series.append(Series(steps, silent, name, color=color, line="dot", markers=True))
    caption = "A task whose rewards are all zero cannot be told from others by its rewards. Means over parts."
    y = Axis("share", -0.03, 1.03)
    return Figure("silence", caption, Axis(STEPS), y, (Frame("", tuple(series)),), height=340)


def rewards(content: Content) -> Figure:
    """How rewards are distributed, snapshot by snapshot."""
    edges = np.array(content.rewards.edges)
    middles = (edges[1:] + edges[:-1]) / 2
    frames = []
    for step, stages in by_step(content.rewards.stages).items():
        bars = tuple(
            Series(
                middles,
                np.array(stage.counts) / max(1, sum(stage.counts)),
                f"{stage.split} tasks",
                color=SPLITS.index(stage.split),
                bars=True,
            )
            for stage in stages
        )
        frames.append(Frame(f"step {step:,}", bars))
    caption = "The outermost bars also count what lies beyond them. The vertical axis is logarithmic."
    x, y = Axis("reward", float(edges[0]), float(edges[-1])), Axis("share of rewards", is_log=True)
    return Figure("rewards", caption, x, y, tuple(frames), "snapshot", height=340, start=len(frames) - 1)


def by_step(stages: Iterable[AnyStage]) -> dict[int, list[AnyStage]]:
    """Stages by step, ascending."""
    found: dict[int, list[AnyStage]] = {}
    for stage in stages:
        found.setdefault(stage.step, []).append(stage)
    return dict(sorted(found.items()))


def ticks(names: list[str]) -> dict[float, str]:
    """Names of rows or columns 0, 1, …; of many, evenly chosen ones."""
    places = np.unique(np.linspace(0, len(names) - 1, MOST_TICKS).round().astype(int))
    return {float(place): names[place] for place in places}
