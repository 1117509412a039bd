"""Every task's last policy in every task: how much a policy is worth where it was not trained."""

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import SPLITS
from tcmrl_data.dataset.selection import chosen_parts
from tcmrl_data.envs.base import Environment, Split, Task, in_order
from tcmrl_data.envs.rollout import (
    BelievingController,
    Controller,
    DeterministicController,
    FloatArray,
    first_observation,
    hidden_entries,
    roll_out,
)
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.seeding import Purpose, evenly_spread, keyed_generator, keyed_seed
from tcmrl_data.parts.making import one_thread
from tcmrl_data.quality import measured
from tcmrl_data.store.tables import MAIN_RUN, PartKey

EPISODES = 5
"""Episodes of a policy in a task by default."""

MOST_TASKS, MOST_SIMULATED_TASKS = 100, 20
"""Tasks that take part by default, without and with a simulator: 100 x 100 x 5 episodes take hours in one."""

MOST_LANES, MOST_SIMULATED_LANES = 1_000, 50
"""Most episodes that are stepped together; 50 lanes of Meta-World take 1 GB."""

Policy = Callable[[int], Controller]
"""Takes a number of lanes and gives a controller for one rollout in them."""


class TransferTask(measured.MeasuredTask):
    """A row and a column of the matrix: a task and its last policy.

    Attributes:
        uniform: mean return of uniform actions in the task, if it is known.
        best: the best return that is known of the task: of the oracle, else the scripted expert, else its
            best snapshot.
    """

    step: int
    run: str
    uniform: float | None
    best: float


class Transfer(measured.Measured):
    """Every last policy in every task: the document of `inspect transfer --json`.

    Attributes:
        left_out: number of the dataset's tasks that take no part, because they are incomplete or too many.
        tasks: rows and columns, training tasks first.
        returns: row i, column j: mean return of the policy of task i in task j.
        scores: the same in units of `tq`; None where the task has no references.
    """

    seed: int
    episodes: int
    deterministic: bool
    left_out: int
    tasks: tuple[TransferTask, ...]
    returns: tuple[tuple[float, ...], ...]
    scores: tuple[tuple[float | None, ...], ...]


def measure_transfer(
    dataset: Dataset,
    *,
    tasks: int | None = None,
    episodes: int = EPISODES,
    seed: int = 0,
    deterministic: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Transfer:
    """Lets the last policy of every task act in every task.

    A policy never sees in which task it acts: entries of observations that tell the task stay those of its
    own. Episode n in a task has the same seeds for all policies, so that they are compared alike. The same
    seed and platform give the same returns.

    Args:
        dataset: with its policies and an environment that is installed.
        tasks: most tasks that take part, evenly spread over both splits; None for 100, or 20 where a task is
            simulated.
        progress: called with episodes done and episodes in all.

    Raises:
        SelectionError: fewer than two complete tasks, or numbers out of range.
        SnapshotError: a task's last part holds no policy.
        StoreError: a part is damaged.

    Example:
        >>> measure_transfer(open_dataset("data/point-robot"), tasks=10).returns  # doctest: +SKIP
    """
    environment = dataset.environment
    most = MOST_SIMULATED_TASKS if environment.simulator_bytes else MOST_TASKS
    chosen = _chosen_tasks(dataset, most if tasks is None else tasks)
    if episodes < 1:
        raise SelectionError(f"--episodes {episodes} is not a positive number")
    keys = [last_part(dataset, task) for task in chosen]
    policies = [
        _policy(dataset, task, key, deterministic=deterministic)
        for task, key in zip(chosen, keys, strict=True)
    ]
    with one_thread():
        returns = _play(environment, chosen, policies, episodes=episodes, seed=seed, progress=progress)
    columns = [_transfer_task(dataset, task, key) for task, key in zip(chosen, keys, strict=True)]
    return Transfer(
        **measured.heading(dataset),
        seed=seed,
        episodes=episodes,
        deterministic=deterministic,
        left_out=len(dataset.tasks) - len(chosen),
        tasks=tuple(columns),
        returns=tuple(tuple(row) for row in returns.tolist()),
        scores=tuple(
            tuple(_score(value, column) for value, column in zip(row, columns, strict=True))
            for row in returns.tolist()
        ),
    )


def _chosen_tasks(dataset: Dataset, number: int) -> list[Task]:
    """At most `number` complete tasks, training tasks first, evenly spread along the environment's ordering.

    Both splits keep their share of the tasks, and at least one task each.
    """
    complete = [task for task in dataset.tasks if not dataset.missing(task.index)]
    complete = [task for task in complete if dataset.parts.keys_of(task.index)]
    by_split: dict[Split, list[Task]] = {
        split: in_order(dataset.environment, [task for task in complete if task.split == split])
        for split in SPLITS
    }
    share = min(1.0, number / max(1, len(complete)))
    train, test = by_split["train"], by_split["test"]
    num_test = max(1, round(share * len(test))) if test else 0
    chosen = [*evenly_spread(train, max(1, number - num_test)), *evenly_spread(test, num_test)]
    if len(chosen) < 2 or not train:
        raise SelectionError(
            f"{dataset.path}: policies are compared between at least two complete tasks, one of them for "
            f"training; {len(complete)} of {len(dataset.tasks)} are complete, {number} were wanted at most"
        )
    return chosen


def last_part(dataset: Dataset, task: Task) -> PartKey:
    """The last part of a task, of the run `main` where it has one."""
    keys = chosen_parts(dataset, task.index, "last")
    return min(keys, key=lambda key: (key.run != MAIN_RUN, key.run))


def _policy(dataset: Dataset, task: Task, key: PartKey, *, deterministic: bool) -> Policy:
    environment, snapshot = dataset.environment, dataset.snapshot(*key)
    hidden = hidden_entries(environment)
    believed = first_observation(environment, task) if hidden.any() else np.zeros(len(hidden))

    def make(lanes: int) -> Controller:
        acting = snapshot.controller(environment, [task.parameters] * lanes)
        believing = BelievingController(acting, hidden, believed)
        return DeterministicController(believing) if deterministic else believing

    return make


def _play(
    environment: Environment,
    tasks: Sequence[Task],
    policies: Sequence[Policy],
    *,
    episodes: int,
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> FloatArray:
    """Mean returns (policies, tasks); as many episodes as allowed are stepped together."""
    played = [(task, episode) for task in tasks for episode in range(episodes)]
    returns = np.zeros((len(policies), len(played)))
    most = MOST_SIMULATED_LANES if environment.simulator_bytes else MOST_LANES
    for start in range(0, len(played), most):
        chunk = played[start : start + most]
        keys = [(seed, environment.name, task.index) for task, _ in chunk]
        numbers = [episode for _, episode in chunk]
        with contextlib.closing(environment.lanes([task.parameters for task, _ in chunk])) as lanes:
            for row, policy in enumerate(policies):
                trajectories = roll_out(
                    environment,
                    lanes,
                    policy(len(chunk)),
                    reset_seeds=[
                        keyed_seed(*key, Purpose.TRANSFER_RESET, episode)
                        for key, episode in zip(keys, numbers, strict=True)
                    ],
                    noise=[
                        keyed_generator(*key, Purpose.TRANSFER_NOISE, episode)
                        for key, episode in zip(keys, numbers, strict=True)
                    ],
                )
                returns[row, start : start + len(chunk)] = [
                    trajectory.undiscounted_return for trajectory in trajectories
                ]
                if progress:
                    progress(start * len(policies) + (row + 1) * len(chunk), len(played) * len(policies))
    means: FloatArray = returns.reshape(len(policies), len(tasks), episodes).mean(axis=2)
    return means


def _transfer_task(dataset: Dataset, task: Task, key: PartKey) -> TransferTask:
    known = dataset.references(task.index)
    best = next(value for value in (known.oracle, known.scripted, known.behavior) if value is not None)
    return TransferTask(
        task=task.index, split=task.split, step=key.step, run=key.run, uniform=known.uniform, best=best
    )


def _score(value: float, task: TransferTask) -> float | None:
    if task.uniform is None or task.best <= task.uniform:
        return None
    return (value - task.uniform) / (task.best - task.uniform)


def plot_transfer(found: Transfer, file: Path) -> None:
    """Draws the matrix of scores, or of returns where a task has no references; a line parts the splits."""
    figure = measured.new_figure(6.4, 5.4)
    axes = figure.subplots()
    scored = all(score is not None for row in found.scores for score in row)
    rows = [[score or 0.0 for score in row] for row in found.scores] if scored else found.returns
    label = measured.TQ_LABEL if scored else "mean undiscounted return"
    measured.draw_matrix(axes, rows, [task.task for task in found.tasks], label)
    border = sum(task.split == "train" for task in found.tasks) - 0.5
    if border < len(found.tasks) - 1:
        axes.axhline(border, color="white", linewidth=1.2)
        axes.axvline(border, color="white", linewidth=1.2)
    axes.set(xlabel="task acted in (test tasks last)", ylabel="task of the policy")
    axes.set_title(f"{measured.title(found)}: last policies in all tasks")
    measured.save_figure(figure, file)
