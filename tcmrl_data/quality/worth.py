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

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.quality.aggregates import bootstrap_interval
from tcmrl_data.quality.records import SplitWorth, Transfer, Worth, heading
from tcmrl_data.quality.scores import SPLITS
from tcmrl_data.quality.transfer import EPISODES, measure_transfer
from tcmrl_data.quality.visibility import NEIGHBOURS, TRANSITIONS, measure_visibility

StagedProgress = Callable[[str, int, int], None]
"""Takes a stage, `playing` or `reading`, and its amounts done and in all: episodes, then parts."""


def measure_worth(
    dataset: Dataset,
    *,
    tasks: int | None = None,
    episodes: int = EPISODES,
    transitions: int = TRANSITIONS,
    seed: int = 0,
    progress: StagedProgress = lambda stage, done, total: None,
) -> Worth:
    """What a context can gain over the best single policy, and how visible the task is at every stage.

    Args:
        dataset: with its policies and an environment that is installed.
        tasks: as in `measure_transfer`.
        episodes: of a policy in a task.
        transitions: most transitions of a part that are predicted, and most that predict.
        seed: of episodes and samples.
        progress: called with the stage and its amounts.

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
        progress=lambda done, total: progress("playing", done, total),
    )
    stages = measure_visibility(
        dataset,
        transfer.tasks,
        transitions=transitions,
        seed=seed,
        progress=lambda done, total: progress("reading", done, total),
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
