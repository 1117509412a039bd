"""Figures of a dataset's report, one per function."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from tcmrl_data.dataset.returns import SPLITS, summarize_returns
from tcmrl_data.page.figures import GRAY, Axis, Cells, Figure, Frame, Line, Series
from tcmrl_data.report.content import Content
from tcmrl_data.report.excerpts import Browsed
from tcmrl_data.report.measures import ACTION_BINS
from tcmrl_data.store.keys import MAIN_RUN, PartKey

STEPS = "environment steps of behavior training"
RETURN = "mean undiscounted return"
ACTION_ROW, OBSERVATION_ROW = 1, 2


def learning_curves(content: Content) -> Figure:
    """Mean return by snapshot, a thin line per task and run, with means over the tasks of a split."""
    shown = {task.index for task in content.shown}
    series: list[Series] = []
    for color, split in enumerate(SPLITS):
        for task in content.returns["tasks"]:
            if task["split"] == split and task["task"] in shown:
                series += _task_curves(task, color, is_first=not any(line.group == split for line in series))
    for color, split in enumerate(SPLITS):
        rows = [row for row in summarize_returns(content.returns) if row["split"] == split]
        if rows:
            x, y = (np.array([row[name] for row in rows]) for name in ("step", "mean"))
            series.append(Series(x, y, f"mean of {split} tasks", color=color, width=3.5, markers=True))
    steps = content.summary["snapshots"]
    series += list(_references(content, steps[0], steps[-1]))
    caption = (
        "A thin line is a task. Click on an entry of the legend to hide its lines, and again to show them; "
        "point at a line to see which task it is."
    )
    return Figure(
        "learning-curves", caption, Axis(STEPS), Axis(RETURN), (Frame("", tuple(series)),), height=460
    )


def _task_curves(task: dict[str, Any], color: int, *, is_first: bool) -> Iterator[Series]:
    runs = list(dict.fromkeys(found["run"] for found in task["snapshots"]))
    for run in runs:
        own = [found for found in task["snapshots"] if found["run"] == run]
        x, y = (np.array([found[name] for found in own]) for name in ("step", "mean"))
        label = f"task {task['task']} ({task['split']})" + ("" if run == MAIN_RUN else f", {run}")
        name = f"{task['split']} tasks" if is_first and run == runs[0] else ""
        markers = len(own) == 1
        yield Series(x, y, name, task["split"], label, color, width=1.0, opacity=0.45, markers=markers)


def _references(content: Content, low: float, high: float) -> Iterator[Series]:
    """Lines at the means of the reference returns over all tasks that have them."""
    lines: dict[str, Line] = {"oracle": "dash", "scripted": "dash", "uniform": "dot"}
    for name, line in lines.items():
        known = [task["references"][name] for task in content.tasks["tasks"] if task["references"]]
        if known and None not in known:
            mean = float(np.mean(known))
            ends = np.array([low, max(high, low + 1)]), np.array([mean, mean])
            yield Series(*ends, f"{name}, mean of all tasks", color=GRAY, line=line)


def returns_by_snapshot(content: Content) -> Figure:
    """How the returns of episodes are distributed, snapshot by snapshot."""
    episodes = content.episodes
    middles = (episodes.edges[1:] + episodes.edges[:-1]) / 2
    frames = []
    for step in sorted(episodes.found):
        counts = episodes.found[step]
        bars = Series(middles, counts.returns / counts.episodes, bars=True)
        frames.append(Frame(f"step {step:,} ({counts.episodes:,} episodes)", (bars,)))
    top = max(float(frame.series[0].y.max()) for frame in frames)
    x = Axis("undiscounted return of an episode", float(episodes.edges[0]), float(episodes.edges[-1]))
    caption = "All tasks together; the scale stays the same from step to step."
    return Figure(
        "returns",
        caption,
        x,
        Axis("share of episodes", 0.0, 1.05 * top),
        tuple(frames),
        "snapshot",
        height=320,
        start=len(frames) - 1,
    )


def state_visits(content: Content) -> Figure:
    """Where the episodes of a task went, as a heat map of the plane."""
    plane, visits = content.plane, content.visits
    frames = []
    for task in content.shown:
        counts = visits.counts[task.index]
        smallest = counts.astype(np.min_scalar_type(int(counts.max())))  # most of a report is these cells
        frames.append(
            Frame(f"task {task.index} ({task.split})", cells=Cells(smallest, "visits", is_count=True))
        )
    x, y = (Axis(plane.names[axis], float(plane.low[axis]), float(plane.high[axis])) for axis in (0, 1))
    caption = (
        "Number of stored states in each cell, all snapshots of the task together; white was never visited."
    )
    if visits.outside / visits.total >= 5e-5:
        caption += f" {visits.outside / visits.total:.2%} of the states lie outside the picture."
    return Figure(
        "visits",
        caption + _plane_note(content),
        x,
        y,
        tuple(frames),
        "task",
        is_square=_is_square(content),
        height=480,
    )


def trajectories(content: Content) -> Figure:
    """Paths of the first episodes of the first, the middle and the last snapshot of a task."""
    plane, paths = content.plane, content.paths
    frames = []
    for task in content.shown:
        keys = sorted(
            (key for key in paths.found if key.task == task.index), key=lambda key: (key.step, key.run)
        )
        lines = tuple(_path(content, key, place) for place, key in enumerate(keys))
        frames.append(Frame(f"task {task.index} ({task.split})", lines))
    x, y = (Axis(plane.names[axis], float(plane.low[axis]), float(plane.high[axis])) for axis in (0, 1))
    caption = "The first three episodes of the first, the middle and the last snapshot." + _plane_note(
        content
    )
    return Figure(
        "trajectories", caption, x, y, tuple(frames), "task", is_square=_is_square(content), height=480
    )


def _path(content: Content, key: PartKey, place: int) -> Series:
    points = content.paths.found[key]
    name = f"step {key.step:,}" + ("" if key.run == MAIN_RUN else f", {key.run}")
    return Series(points[:, 0], points[:, 1], name, color=(GRAY, 5, 0)[place % 3], width=1.5, opacity=0.8)


def _plane_note(content: Content) -> str:
    explained = content.plane.explained
    if explained is None:
        return ""
    return (
        " The plane is that of the first two principal components of the standardized observations, "
        f"which keep {explained:.0%} of their variance."
    )


def _is_square(content: Content) -> bool:
    """Whether both coordinates have one unit: places in the plane do, principal components do not."""
    return content.plane.explained is None


def action_histograms(content: Content) -> Figure:
    """How actions are distributed, a line per column, snapshot by snapshot."""
    middles = (np.arange(ACTION_BINS) + 0.5) * (2 / ACTION_BINS) - 1
    frames = []
    for step, counts in sorted(content.actions.counts.items()):
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        lines = tuple(
            Series(middles, shares[column], f"action {column}", color=column)
            for column in range(min(8, len(shares)))
        )
        frames.append(Frame(f"step {step:,}", lines))
    top = max(float(line.y.max()) for frame in frames for line in frame.series)
    caption = "Share of the values of each column in 40 bins; peaks at −1 and 1 are saturated actions."
    return Figure(
        "actions",
        caption,
        Axis("action", -1.0, 1.0),
        Axis("share of values", 0.0, 1.05 * top),
        tuple(frames),
        "snapshot",
        height=340,
        start=len(frames) - 1,
    )


def episode_browser(content: Content) -> Figure:
    """Whole episodes: rewards, actions and observations over time."""
    frames = tuple(Frame(_browsed_label(found), tuple(_browsed_series(found))) for found in content.browsed)
    most = content.browsed[0].columns
    drawn = [
        "all columns" if count <= 8 else f"the first 8 of {count} columns" for count in (most[0], most[1])
    ]
    caption = (
        f"Of the observations {drawn[0]} are drawn, of the actions {drawn[1]}. "
        "The same episodes are stored in the parts that the slider names."
    )
    below = (Axis("action", -1.05, 1.05), Axis("observation"))
    return Figure(
        "episodes",
        caption,
        Axis("step of the episode"),
        Axis("reward"),
        frames,
        "episode",
        height=620,
        below=below,
        start=len(frames) - 1,
    )


def _browsed_label(found: Browsed) -> str:
    run = "" if found.key.run == MAIN_RUN else f", {found.key.run}"
    return (
        f"task {found.key.task}, step {found.key.step:,}{run}, episode {found.episode}: "
        f"return {found.total:.4g}, {found.length:,} steps, {found.ended}"
    )


def _browsed_series(found: Browsed) -> Iterator[Series]:
    x = None if np.array_equal(found.steps, np.arange(len(found.steps))) else found.steps
    yield Series(x, found.rewards, label="reward", color=GRAY, markers=len(found.rewards) <= 50)
    for row, name, values in (
        (ACTION_ROW, "action", found.actions),
        (OBSERVATION_ROW, "observation", found.observations),
    ):
        for column in range(values.shape[1]):
            yield Series(x, values[:, column], label=f"{name} {column}", color=column, width=1.5, row=row)
