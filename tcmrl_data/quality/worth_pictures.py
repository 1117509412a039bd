"""Pictures of policies in other tasks and of what a context is worth, for `--plot`."""

from pathlib import Path
from typing import TYPE_CHECKING

from tcmrl_data.dataset.picture import new_figure, save_figure
from tcmrl_data.quality.pictures import COLORS, STEPS_LABEL, draw_matrix, label_axes, title
from tcmrl_data.quality.records import Transfer, Worth

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_transfer(found: Transfer, file: Path) -> None:
    """Draws the matrix of scores, or of returns where a task has no references; a line parts the splits.

    Raises:
        SelectionError: the file's name is none of a picture.
    """
    figure = new_figure(6.4, 5.4)
    axes = figure.subplots()
    scored = all(score is not None for row in found.scores for score in row)
    rows = [[score or 0.0 for score in row] for row in found.scores] if scored else found.returns
    label = "trajectory quality (0 uniform, 1 best known)" if scored else "mean undiscounted return"
    draw_matrix(axes, rows, [task.task for task in found.tasks], label)
    border = sum(task.split == "train" for task in found.tasks) - 0.5
    if border < len(found.tasks) - 1:
        axes.axhline(border, color="white", linewidth=1.2)
        axes.axvline(border, color="white", linewidth=1.2)
    axes.set(xlabel="task acted in (test tasks last)", ylabel="task of the policy")
    axes.set_title(f"{title(found)}: last policies in all tasks")
    save_figure(figure, file)


def plot_worth(found: Worth, file: Path) -> None:
    """Draws returns of the best single and of own policies within their range, and visibility by step.

    Raises:
        SelectionError: the file's name is none of a picture.
    """
    figure = new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2)
    _draw_returns(left, found)
    for split, color in COLORS.items():
        stages = [stage for stage in found.stages if stage.split == split]
        for name, line in (("reward", "o-"), ("dynamics", "s--")):
            points = [
                (stage.step, getattr(stage, name)) for stage in stages if getattr(stage, name) is not None
            ]
            if points:
                label = f"{split}, in {'rewards' if name == 'reward' else name}"
                right.plot(*zip(*points, strict=True), line, color=color, label=label, markersize=4)
    right.axhline(0.0, color="0.3", linestyle=":", linewidth=0.9)
    label_axes(right, "visibility of the task", STEPS_LABEL, "visibility (0 invisible, 1 plain to see)")
    if found.stages:
        right.legend(fontsize="small")
    save_figure(figure, file)


def _draw_returns(axes: "Axes", found: Worth) -> None:
    """A bar per split from uniform to best known, with the best single policy and own policies on it."""
    for place, row in enumerate(found.splits):
        if row.uniform is not None:
            axes.bar(place, row.best - row.uniform, 0.5, bottom=row.uniform, color="0.88", zorder=1)
        gain = row.own - row.single
        axes.bar(place, gain, 0.5, bottom=row.single, color=COLORS[row.split], alpha=0.7, zorder=2)
        worth = "" if row.worth is None else f"worth {row.worth:.0%}"
        axes.text(place + 0.28, (row.own + row.single) / 2, worth, va="center", fontsize="small")
    axes.set_xlim(-0.5, len(found.splits))
    label_axes(axes, title(found), "", "mean undiscounted return")
    axes.set_xticks(range(len(found.splits)), [f"{row.split} ({row.tasks} tasks)" for row in found.splits])
    axes.set_xlabel("colored: from the best single policy to own policies\ngrey: from uniform to best known")
