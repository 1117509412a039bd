"""Is a context worth having? What it can gain, and how visible the task is in the data of a stage.

Both are known before anyone trains. Visibility: the reward and the change of the observation of a transition
are predicted as the mean of those of its nearest neighbours in (observation, action), once among transitions
of the same task and once among as many of other tasks. If the same task predicts better, something that the
observation does not show differs between tasks.

Weak spots:

- The best stored policy is a lower bound of the best policy without a context, so that `worth` is an upper
  bound; it is a low one where the tasks' own policies are far from the best that is known.
- Where rewards do not vary, visibility in rewards is not defined.
- In stages whose policies have become narrow, transitions of other tasks lie elsewhere: visibility in
  dynamics then mixes the task with the coverage.
- A transition is looked at alone. What only a sequence of transitions tells is not seen.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import SPLITS
from tcmrl_data.envs.base import Split
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator
from tcmrl_data.quality import measured
from tcmrl_data.quality.scores import bootstrap_interval
from tcmrl_data.quality.transfer import EPISODES, Transfer, TransferTask, measure_transfer

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEIGHBOURS = 5
"""Nearest neighbours of a prediction."""

TRANSITIONS = 500
"""Most transitions of a part that are predicted, and most that predict, by default."""

SMALLEST_ERROR = 1e-12
"""Squared errors below this share of the mean square are zero but for rounding."""


class SplitWorth(Record):
    """What a context is worth in the tasks of a split.

    Attributes:
        own: mean return of the tasks' own policies.
        single: mean return in these tasks of the best single policy, which is the same in both splits.
        best: mean of the best returns that are known of the tasks.
        worth: (own − single) / (best − uniform).
        low: lower end of the 95% bootstrap interval of `worth` over tasks; None with fewer than five.
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


class StageVisibility(measured.MeasuredStage):
    """How visible the task is in the data of a stage.

    Attributes:
        rewarded: share of steps with a reward other than zero.
        reward: visibility in rewards: 1 − (squared error of predictions from the same task) / (from other
            tasks). 1 is plain to see, 0 is invisible; None where rewards cannot be told apart at all.
        dynamics: visibility in the changes of observations.
    """

    tasks: int
    rewarded: float
    reward: float | None
    dynamics: float | None


class Worth(measured.Measured):
    """Whether a context is worth having: the document of `inspect worth --json`.

    Attributes:
        transitions: most transitions of a part that are predicted, and that predict.
        left_out: number of tasks that take no part.
        single_task: the training task whose policy does best in all training tasks.
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
        transitions: most transitions of a part that are predicted, and most that predict.
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
        raise SelectionError(f"transitions {transitions} is less than the {NEIGHBOURS} neighbours")
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
        **measured.heading(dataset),
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


@dataclass(frozen=True)
class Half:
    """Transitions of half of a part's episodes.

    Attributes:
        inputs: (n, observation_dim + action_dim).
        rewards: (n, 1).
        changes: (n, observation_dim), next observation minus observation.
    """

    inputs: FloatArray
    rewards: FloatArray
    changes: FloatArray

    def rows(self, chosen: npt.NDArray[np.intp]) -> "Half":
        """Some of the transitions."""
        return Half(self.inputs[chosen], self.rewards[chosen], self.changes[chosen])


@dataclass(frozen=True)
class Sample:
    """Transitions of a part: `known` ones predict `asked` ones, and no episode has a part in both."""

    known: Half
    asked: Half
    rewarded: float


def measure_visibility(
    dataset: Dataset,
    tasks: Sequence[TransferTask],
    *,
    transitions: int = TRANSITIONS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[StageVisibility]:
    """How visible the task is at every step of some tasks' runs, training and test tasks apart.

    Parts with fewer than two episodes are left out. Samples of the parts of one step are in memory.

    Args:
        transitions: most transitions of a part that are predicted, and most that predict.
    """
    keys = [
        (task.split, key) for task in tasks for key in dataset.parts.keys_of(task.task) if key.run == task.run
    ]
    done = 0
    for step, split, members in measured.by_stage(keys):
        samples = []
        for key in members:
            generator = keyed_generator(seed, dataset.name, key.task, Purpose.VISIBILITY, step)
            sample = draw_sample(measured.read_steps(dataset, key), transitions, generator)
            samples += [sample] if sample is not None else []
            done += 1
            if progress:
                progress(done, len(keys))
        if samples:
            generator = keyed_generator(seed, dataset.name, NO_TASK, Purpose.VISIBILITY, step)
            reward, dynamics = visibility(samples, generator)
            yield StageVisibility(
                step=step,
                split=split,
                tasks=len(samples),
                rewarded=float(np.mean([sample.rewarded for sample in samples])),
                reward=reward,
                dynamics=dynamics,
            )


def draw_sample(steps: measured.PartSteps, most: int, generator: np.random.Generator) -> Sample | None:
    """At most `most` transitions of even episodes, which predict, and of odd ones; None if one is empty."""
    odd = np.repeat(np.arange(len(steps.lengths)) % 2 == 1, steps.lengths)
    halves = []
    for members in (np.flatnonzero(~odd), np.flatnonzero(odd)):
        if not len(members):
            return None
        chosen = np.sort(generator.choice(members, min(most, len(members)), replace=False))
        halves.append(
            Half(
                np.concatenate([steps.observations[chosen], steps.actions[chosen]], axis=1),
                steps.rewards[chosen, None],
                steps.next_observations[chosen] - steps.observations[chosen],
            )
        )
    return Sample(halves[0], halves[1], float(np.mean(steps.rewards != 0)))


def visibility(
    samples: Sequence[Sample], generator: np.random.Generator
) -> tuple[float | None, float | None]:
    """Visibility in rewards and in changes of observations: 1 − E_same / E_other.

    E_same sums the squared errors of predictions from the same task, E_other those from as many transitions
    of the other tasks; changes are summed over columns, in standard deviations. None with fewer than two
    tasks, and where the other tasks predict without error.
    """
    if len(samples) < 2:
        return None, None
    pool = Half(
        *(
            np.concatenate([getattr(sample.known, name) for sample in samples])
            for name in ("inputs", "rewards", "changes")
        )
    )
    owner = np.repeat(np.arange(len(samples)), [len(sample.known.inputs) for sample in samples])
    scales = {name: _scale(getattr(pool, name)) for name in ("inputs", "rewards", "changes")}
    pool = _scaled(pool, scales)
    errors = np.zeros((2, 2))  # (same, other) x (rewards, changes)
    for task, sample in enumerate(samples):
        own, others = np.flatnonzero(owner == task), np.flatnonzero(owner != task)
        others = generator.choice(others, min(len(own), len(others)), replace=False)
        asked = _scaled(sample.asked, scales)
        errors[0] += _squared_errors(pool.rows(own), asked)
        errors[1] += _squared_errors(pool.rows(others), asked)
    nothing = SMALLEST_ERROR * sum(len(sample.asked.inputs) for sample in samples)
    reward, dynamics = (None if other <= nothing else float(1.0 - same / other) for same, other in errors.T)
    return reward, dynamics


def _scale(values: FloatArray) -> FloatArray:
    """One over the standard deviation of every column; 0 for columns that do not vary."""
    std = values.std(axis=0)
    varies = std > measured.SMALLEST_STD * np.maximum(1.0, np.abs(values).max(axis=0))
    scale: FloatArray = np.where(varies, 1.0 / np.where(varies, std, 1.0), 0.0)
    return scale


def _scaled(half: Half, scales: dict[str, FloatArray]) -> Half:
    return Half(*(getattr(half, name) * scale for name, scale in scales.items()))


def _squared_errors(known: Half, asked: Half) -> tuple[float, float]:
    """Sums of squared errors of rewards and of changes, predicted by the nearest neighbours."""
    from scipy.spatial import KDTree

    neighbours = list(range(1, min(NEIGHBOURS, len(known.inputs)) + 1))
    _, found = KDTree(known.inputs).query(asked.inputs, k=neighbours)
    rewards = known.rewards[found].mean(axis=1) - asked.rewards
    changes = known.changes[found].mean(axis=1) - asked.changes
    return float(np.square(rewards).sum()), float(np.square(changes).sum())


def plot_worth(found: Worth, file: Path) -> None:
    """Draws returns of the best single and of own policies within their range, and visibility by step."""
    figure = measured.new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2)
    _draw_returns(left, found)
    for split, color in measured.COLORS.items():
        stages = [stage for stage in found.stages if stage.split == split]
        for name, line in (("reward", "o-"), ("dynamics", "s--")):
            points = [
                (stage.step, getattr(stage, name)) for stage in stages if getattr(stage, name) is not None
            ]
            if points:
                label = f"{split}, in {'rewards' if name == 'reward' else name}"
                right.plot(*zip(*points, strict=True), line, color=color, label=label, markersize=4)
    right.axhline(0.0, color="0.3", linestyle=":", linewidth=0.9)
    measured.label_axes(
        right, "visibility of the task", measured.STEPS_LABEL, "visibility (0 invisible, 1 plain to see)"
    )
    if found.stages:
        right.legend(fontsize="small")
    measured.save_figure(figure, file)


def _draw_returns(axes: "Axes", found: Worth) -> None:
    """A bar per split from uniform to best known, with the best single policy and own policies on it."""
    for place, row in enumerate(found.splits):
        if row.uniform is not None:
            axes.bar(place, row.best - row.uniform, 0.5, bottom=row.uniform, color="0.88", zorder=1)
        gain = row.own - row.single
        axes.bar(place, gain, 0.5, bottom=row.single, color=measured.COLORS[row.split], alpha=0.7, zorder=2)
        worth = "" if row.worth is None else f"worth {row.worth:.0%}"
        axes.text(place + 0.28, (row.own + row.single) / 2, worth, va="center", fontsize="small")
    axes.set_xlim(-0.5, len(found.splits))
    measured.label_axes(axes, measured.title(found), "", "mean undiscounted return")
    axes.set_xticks(range(len(found.splits)), [f"{row.split} ({row.tasks} tasks)" for row in found.splits])
    axes.set_xlabel("colored: from the best single policy to own policies\ngrey: from uniform to best known")
