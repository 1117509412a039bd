"""Is a context worth having? What it can gain, and how visible the task is in the data.

Both are known before anyone trains. Weak spots:

- The best stored policy is a lower bound of the best policy without a context, so that `worth` is an upper
  bound; it is a low one where the tasks' own policies are far from the best that is known.
- Where rewards do not vary, visibility in rewards is not defined.
- In stages whose policies have become narrow, transitions of other tasks lie elsewhere: visibility in
  dynamics then mixes the task with the coverage.
- A transition is looked at alone. What only a sequence of transitions tells is not seen.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.picture import new_figure, save_figure
from tcmrl_data.dataset.returns import SPLITS
from tcmrl_data.envs.tasks import Split
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import Record
from tcmrl_data.quality.measured import COLORS, STEPS_LABEL, Measured, heading, label_axes, title
from tcmrl_data.quality.scores import bootstrap_interval
from tcmrl_data.quality.transfer import EPISODES, Transfer, measure_transfer
from tcmrl_data.quality.visibility import NEIGHBOURS, TRANSITIONS, StageVisibility, measure_visibility

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class SplitWorth(Record):
    """What a context is worth in the tasks of a split.

    Attributes:
        split: of the tasks.
        tasks: number of tasks.
        own: mean return of the tasks' own policies.
        single: mean return in these tasks of the best single policy, which is the same in both splits.
        uniform: mean return of uniform actions.
        best: mean of the best returns that are known of the tasks.
        worth: (own − single) / (best − uniform).
        low: lower end of the 95% bootstrap interval of `worth` over tasks; None with fewer than five.
        high: upper end.
    """

    split: Split
    tasks: int
    own: float
    single: float
    uniform: float | None
    best: float
    worth: float | None
    low: float | None
    high: float | None


class Worth(Measured):
    """Whether a context is worth having: the document of `inspect worth --json`.

    Attributes:
        seed: of episodes and samples.
        episodes: of a policy in a task.
        transitions: most transitions of a part that are predicted, and that predict.
        neighbours: nearest neighbours of a prediction.
        left_out: number of tasks that take no part.
        single_task: the training task whose policy does best in all training tasks.
        splits: what a context is worth.
        stages: how visible the task is.
    """

    seed: int
    episodes: int
    transitions: int
    neighbours: int
    left_out: int
    single_task: int
    splits: tuple[SplitWorth, ...]
    stages: tuple[StageVisibility, ...]


def measure_worth(
    dataset: Dataset,
    *,
    tasks: int | None = None,
    episodes: int = EPISODES,
    transitions: int = TRANSITIONS,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Worth:
    """What a context can gain over the best single policy, and how visible the task is at every stage.

    Args:
        dataset: with its policies and an environment that is installed.
        tasks: as in `measure_transfer`.
        episodes: of a policy in a task.
        transitions: most transitions of a part that are predicted, and most that predict.
        seed: of episodes and samples.
        progress: called with a stage, `playing` or `reading`, and its amounts done and in all: episodes, then
            parts.

    Raises:
        SelectionError: too few complete tasks, or numbers out of range.
        SnapshotError: a task's last part holds no policy.
        StoreError: a part is damaged.

    Example:
        >>> worth = measure_worth(open_dataset("data/point-robot-wind"))  # doctest: +SKIP
        >>> worth.splits[0].worth  # doctest: +SKIP
        0.02
    """
    if transitions < NEIGHBOURS:
        raise SelectionError(f"--transitions {transitions} is less than the {NEIGHBOURS} neighbours")
    transfer = measure_transfer(
        dataset,
        tasks=tasks,
        episodes=episodes,
        seed=seed,
        progress=progress and (lambda done, total: progress("playing", done, total)),
    )
    stages = measure_visibility(
        dataset,
        transfer.tasks,
        transitions=transitions,
        seed=seed,
        progress=progress and (lambda done, total: progress("reading", done, total)),
    )
    single, splits = context_worth(transfer)
    return Worth(
        **heading(dataset),
        seed=seed,
        episodes=episodes,
        transitions=transitions,
        neighbours=NEIGHBOURS,
        left_out=transfer.left_out,
        single_task=single,
        splits=splits,
        stages=tuple(stages),
    )


def context_worth(transfer: Transfer) -> tuple[int, tuple[SplitWorth, ...]]:
    """The training task whose policy does best in all training tasks, and what a context gains over it.

    The policy is chosen by its mean return in the training tasks, its own one among them, and is the same for
    test tasks, whose own policies are never candidates.

    Args:
        transfer: every last policy in every task.
    """
    returns = np.array(transfer.returns)
    training = np.array([task.split == "train" for task in transfer.tasks])
    candidates = np.flatnonzero(training)
    single = int(candidates[returns[np.ix_(training, training)].mean(axis=1).argmax()])
    splits = []
    for split in SPLITS:
        members = np.array([task.split == split for task in transfer.tasks])
        if members.any():
            splits.append(
                _split_worth(transfer, returns.diagonal()[members], returns[single, members], members)
            )
    return transfer.tasks[single].task, tuple(splits)


def _split_worth(
    transfer: Transfer, own: FloatArray, single: FloatArray, members: npt.NDArray[np.bool_]
) -> SplitWorth:
    """Worth in the tasks that `members` marks, from the returns of their own and the single policy."""
    tasks = [task for task, is_member in zip(transfer.tasks, members, strict=True) if is_member]
    best = np.array([task.best for task in tasks])
    uniforms = [task.uniform for task in tasks if task.uniform is not None]
    worth, low, high = None, None, None
    if len(uniforms) == len(tasks) and best.mean() > np.mean(uniforms):
        gains, ranges = own - single, best - np.array(uniforms)
        worth = float(gains.mean() / ranges.mean())
        low, high = bootstrap_interval(
            len(tasks), lambda resamples: gains[resamples].mean(axis=1) / ranges[resamples].mean(axis=1)
        )
    return SplitWorth(
        split=tasks[0].split,
        tasks=len(tasks),
        own=float(own.mean()),
        single=float(single.mean()),
        uniform=float(np.mean(uniforms)) if len(uniforms) == len(tasks) else None,
        best=float(best.mean()),
        worth=worth,
        low=low,
        high=high,
    )


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
