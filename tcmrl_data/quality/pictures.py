"""Pictures of what was measured, for `--plot`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tcmrl_data.dataset.picture import new_figure, save_figure
from tcmrl_data.envs.tasks import Split
from tcmrl_data.quality.records import Coverage, Measured, Quality, Rewards

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS: dict[Split, str] = {"train": "tab:blue", "test": "tab:orange"}
STEPS_LABEL = "environment steps of behavior training"
TQ_LABEL = "trajectory quality (0 uniform, 1 best known)"

TICKS = 20
"""Most tasks that are named along an axis of a matrix."""


def plot_quality(found: Quality, file: Path) -> None:
    """Draws trajectory quality by step: a thin line per task, and the interquartile mean of each split.

    Raises:
        SelectionError: the file's name is none of a picture.
    """
    figure = new_figure(7.0, 4.2)
    axes = figure.subplots()
    for task in found.tasks:
        points = [(row.step, row.tq) for row in task.snapshots if row.tq is not None]
        steps, values = zip(*points, strict=True) if points else ((), ())
        axes.plot(steps, values, color=COLORS[task.split], alpha=0.3, linewidth=0.8)
    for split in COLORS:
        _draw_split(axes, found, split)
    for level in (0.0, 1.0):
        axes.axhline(level, color="0.3", linestyle=":", linewidth=0.9)
    label_axes(axes, title(found), STEPS_LABEL, TQ_LABEL)
    axes.legend(fontsize="small")
    save_figure(figure, file)


def plot_coverage(found: Coverage, file: Path) -> None:
    """Draws coverage against trajectory quality, a line per split along the steps, and overlaps of tasks.

    Raises:
        SelectionError: the file's name is none of a picture.
    """
    figure = new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2)
    for split, color in COLORS.items():
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
    label_axes(left, title(found), "state-action coverage (share of the task's cells)", TQ_LABEL)
    left.legend(fontsize="small")
    draw_matrix(right, found.overlap.shares, found.overlap.tasks, "share of states visited too")
    right.set(title="states that tasks share", xlabel="task", ylabel="task")
    save_figure(figure, file)


def plot_rewards(found: Rewards, file: Path) -> None:
    """Draws the distribution of rewards by step, training tasks, and the share of zero rewards.

    Raises:
        SelectionError: the file's name is none of a picture.
    """
    figure = new_figure(10.0, 4.4)
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
    left.set(title=f"{title(found)}: rewards, {stages[0].split} tasks", xlabel=STEPS_LABEL, ylabel="reward")
    left.figure.colorbar(image, ax=left, label="share of steps in a bin")
    for split, color in COLORS.items():
        rows = [stage for stage in found.stages if stage.split == split]
        steps = [stage.step for stage in rows]
        right.plot(steps, [stage.zero for stage in rows], "o-", color=color, label=f"{split}, zero rewards")
        right.plot(
            steps, [stage.silent for stage in rows], "s--", color=color, label=f"{split}, silent episodes"
        )
    right.set_ylim(-0.03, 1.03)
    label_axes(right, "how often there is no reward", STEPS_LABEL, "share")
    right.legend(fontsize="small")
    save_figure(figure, file)


def draw_matrix(axes: "Axes", rows: Sequence[Sequence[float]], tasks: Sequence[int], label: str) -> None:
    """A matrix of tasks by tasks; at most TICKS of them are named."""
    image = axes.imshow(rows, cmap="viridis", interpolation="nearest")
    every = max(1, -(-len(tasks) // TICKS))
    places = range(0, len(tasks), every)
    names = [str(tasks[place]) for place in places]
    axes.set_xticks(places, names, rotation=90, fontsize="small")
    axes.set_yticks(places, names, fontsize="small")
    axes.figure.colorbar(image, ax=axes, label=label)


def _draw_split(axes: "Axes", found: Quality, split: Split) -> None:
    """The interquartile means of a split, with their interval where it is known."""
    stages = [(stage.step, stage.tq) for stage in found.stages if stage.split == split and stage.tq]
    if not stages:
        return
    steps, spreads = zip(*stages, strict=True)
    label = f"{split}, interquartile mean and 95%"
    axes.plot(steps, [tq.iqm for tq in spreads], "o-", color=COLORS[split], label=label)
    if all(tq.low is not None for tq in spreads):
        ends = ([tq.low for tq in spreads], [tq.high for tq in spreads])
        axes.fill_between(steps, *ends, color=COLORS[split], alpha=0.25, linewidth=0)


def title(found: Measured) -> str:
    """What a picture calls its dataset."""
    return found.label or found.environment


def label_axes(axes: "Axes", heading: str, x: str, y: str) -> None:
    """Gives axes a title, labels and a light grid."""
    axes.set_title(heading)
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
