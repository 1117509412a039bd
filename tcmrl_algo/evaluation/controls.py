"""Controls of a dataset: returns of policies without any learning across tasks, measured once and kept.

A kept file lies in the cache (`tcmrl_data.cache_folder`). Its name is a digest of everything that the returns
are a function of: the dataset's parts and splits, the environment's libraries and this package's versions.
"""

import contextlib
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt

from tcmrl_algo.algorithms.core.problem import SMALLEST_STD, numbers
from tcmrl_algo.evaluation.arena import LaneStage, ProgressCallback, ignore_progress
from tcmrl_data import (
    BelievingController,
    Controller,
    Dataset,
    DeterministicController,
    Purpose,
    Task,
    TrainingError,
    cache_folder,
    first_observation,
    hidden_entries,
)
from tcmrl_data.foundation.disk import make_folders
from tcmrl_data.foundation.errors import StorageError
from tcmrl_data.foundation.records import Frozen, digest, read_record, write_record
from tcmrl_data.foundation.seeding import evenly_spread


class FixedSnapshot(Frozen):
    """The training task's last policy that does best in all training tasks.

    Attributes:
        task, step, run: the part that holds the policy.
        train_return: mean over the training tasks.
        train_returns: mean of every candidate that was tried in all of them, by the candidate's task.
        average_return: mean over all candidates, in the training tasks in which all were tried: what the
            choice of the best is worth, for which candidates act in the tasks.
    """

    task: int
    step: int
    run: str
    train_return: float
    train_returns: dict[int, float]
    average_return: float


class FixedTarget(Frozen):
    """The task parameters whose oracle does best in all training tasks.

    Attributes:
        parameters: of no task in particular.
        train_return: mean over the training tasks.
    """

    parameters: dict[str, Any]
    train_return: float


class TaskControls(Frozen):
    """Returns in one test task, all undiscounted means; None for what the environment or dataset lacks.

    Attributes:
        behavior: of the best of the task's own behavior policies, without their noise.
        behavior_step: training step of that policy.
        fixed_snapshot, fixed_target: of the fixed policies of these names.
        fixed: of the one of the two that does better in the training tasks.
    """

    task: int
    uniform: float | None
    oracle: float | None
    behavior: float | None
    behavior_step: int | None
    fixed_snapshot: float | None
    fixed_target: float | None
    fixed: float | None


class Controls(Frozen):
    """What adaptation is compared with on a dataset; the document of `tcmrl controls --json`.

    The fixed policies are fitted on the training tasks and act the same in every task. A behavior policy that
    observes what the stored view hides keeps the values of its own task.

    Attributes:
        fixed_snapshot, fixed_target: the fixed policies; None where there are no stored policies or no
            oracle.
    """

    schema_version: Literal[2] = 2
    environment: str
    dataset_root: str
    splits: dict[int, str]
    versions: dict[str, str]
    fingerprint: dict[str, Any]
    fixed_snapshot: FixedSnapshot | None = None
    fixed_target: FixedTarget | None = None
    tasks: tuple[TaskControls, ...] = ()

    def task(self, index: int) -> TaskControls | None:
        """The controls of a test task; None of a training task, where none are measured."""
        return next((task for task in self.tasks if task.task == index), None)

    def mean(self, name: str) -> float | None:
        """Mean over the test tasks of the returns called `name`; None if a task has none."""
        values = [getattr(task, name) for task in self.tasks]
        return None if None in values or not values else fmean(values)


FloatArray = npt.NDArray[np.floating]

MOST_EVALUATIONS = 200
"""Of the search for a target; two coordinates take about 80."""


def best_target(
    tasks: Sequence[Task], mean_return: Callable[[Mapping[str, Any]], float]
) -> tuple[dict[str, Any], float]:
    """Task parameters whose oracle does best in all tasks, by a simplex search, and the mean return.

    The search starts at the best of the tasks' own parameters and their mean. Parameters that all tasks
    share stay what they are.

    Args:
        mean_return: the mean over the tasks of the returns of the oracle for given parameters.
    """
    from scipy.optimize import minimize

    table = np.array([numbers(task.parameters) for task in tasks])
    varying = table.std(axis=0) > SMALLEST_STD

    def parameters(values: FloatArray) -> dict[str, Any]:
        row = np.where(varying, 0.0, table[0])
        row[varying] = values
        found: dict[str, Any] = with_numbers(tasks[0].parameters, iter(row.tolist()))
        return found

    starts = [*table[:, varying], table[:, varying].mean(axis=0)]
    start = max(starts, key=lambda values: mean_return(parameters(values)))
    found = minimize(
        lambda values: -mean_return(parameters(values)),
        start,
        method="Nelder-Mead",
        options={"maxfev": MOST_EVALUATIONS, "initial_simplex": _simplex(start, table[:, varying])},
    )
    return parameters(found.x), -float(found.fun)


def _simplex(start: FloatArray, table: FloatArray) -> FloatArray:
    """The start and steps from it along every axis, of half a standard deviation over the tasks."""
    return np.concatenate([start[None], start + np.diag(table.std(axis=0) / 2)])


def with_numbers(value: Any, replacements: Iterator[float]) -> Any:
    """The JSON value with its numbers replaced in the order of `leaves`."""
    if isinstance(value, Mapping):
        return {key: with_numbers(value[key], replacements) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [with_numbers(item, replacements) for item in value]
    return next(replacements) if isinstance(value, int | float) else value


TEST_EPISODES = 5
"""Episodes per policy and test task; one per policy and training task choose the fixed policies."""

SCREENING_TASKS, FINALISTS = 10, 5
"""Training tasks in which all candidates for a fixed policy are tried, and candidates tried in all tasks."""

Control = Callable[[Sequence[Task]], Controller]
"""How a policy acts in lanes of some tasks."""


@final
class ControlBench:
    """Runs policies in the tasks of a dataset."""

    def __init__(self, dataset: Dataset, report: ProgressCallback) -> None:
        self.dataset, self._report = dataset, report
        # without noise, the purpose of the noise does not matter
        self._stage = LaneStage(
            dataset.environment,
            seed=dataset.manifest.seed or 0,
            reset=Purpose.CONTROL_RESET,
            noise=Purpose.CONTROL_RESET,
        )
        self._hidden = hidden_entries(dataset.environment)
        self._done = 0
        tasks = len(dataset.train_tasks)
        candidates = tasks * min(SCREENING_TASKS, tasks) + (
            FINALISTS * tasks if tasks > SCREENING_TASKS else 0
        )
        own = sum(len(dataset.parts.keys_of(task.index)) for task in dataset.test_tasks)
        self._total = candidates + (own + len(dataset.test_tasks)) * TEST_EPISODES

    def close(self) -> None:
        """Closes all lanes."""
        self._stage.close()

    def returns(self, tasks: Sequence[Task], control: Control, episodes: int) -> list[float]:
        """Mean return of every task; all episodes are stepped together."""

        def count(done: int) -> None:
            self._done = min(self._total, self._done + done)
            self._report("controls", self._done, self._total)

        lanes = [task for task in tasks for _ in range(episodes)]
        trajectories = self._stage.run(lanes, lambda chunk: control(lanes[chunk]), episode=0, done=count)
        returns = np.array([trajectory.undiscounted_return for trajectory in trajectories])
        return [float(value) for value in returns.reshape(len(tasks), episodes).mean(axis=1)]

    def fixed_snapshot(
        self,
    ) -> tuple[FixedSnapshot | None, Control | None]:
        """The best of the training tasks' last policies, and how it acts in any task.

        With more than SCREENING_TASKS training tasks, the FINALISTS that do best in evenly spaced ones of
        them are compared in all.
        """
        training = self.dataset.train_tasks
        found = {
            key: control
            for task in training
            for key in self.dataset.select(tasks=[task.index], snapshots="last").parts[task.index]
            if (control := self._policy(task, key.step, key.run)) is not None
        }
        if not found:
            return None, None
        screening = evenly_spread(training, SCREENING_TASKS)
        means = {key: fmean(self.returns(screening, control, 1)) for key, control in found.items()}
        average = fmean(means.values())
        if len(training) > SCREENING_TASKS:
            finalists = sorted(means, key=means.__getitem__)[-FINALISTS:]
            means = {key: fmean(self.returns(training, found[key], 1)) for key in finalists}
        best = max(means, key=means.__getitem__)
        returns = {key.task: means[key] for key in sorted(means, key=means.__getitem__)}
        record = FixedSnapshot(
            task=best.task,
            step=best.step,
            run=best.run,
            train_return=means[best],
            train_returns=returns,
            average_return=average,
        )
        return record, found[best]

    def fixed_target(self) -> FixedTarget | None:
        """The best target of the oracle; None without an oracle."""
        training = self.dataset.train_tasks
        if self.dataset.environment.oracle([training[0].parameters]) is None:
            return None

        def mean_return(parameters: Mapping[str, Any]) -> float:
            return fmean(self.returns(training, self._oracle(parameters), 1))

        parameters, mean = best_target(training, mean_return)
        return FixedTarget(parameters=parameters, train_return=mean)

    def oracle(self, target: FixedTarget) -> Control:
        """How the oracle acts in any task that believes in the target."""
        return self._oracle(target.parameters)

    def task_controls(
        self,
        task: Task,
        *,
        fixed_snapshot: float | None,
        fixed_target: float | None,
        fixed: float | None,
    ) -> TaskControls:
        """Returns of a test task's references and own behavior policies, beside those of the fixed ones."""
        references = self.dataset.references(task.index)
        best: tuple[float, int] | None = None
        for key in self.dataset.parts.keys_of(task.index):
            control = self._policy(task, key.step, key.run)
            if control is not None:
                (mean,) = self.returns([task], control, TEST_EPISODES)
                best = max(best or (mean, key.step), (mean, key.step), key=lambda found: found[0])
        return TaskControls(
            task=task.index,
            uniform=references.uniform,
            oracle=references.oracle,
            behavior=None if best is None else best[0],
            behavior_step=None if best is None else best[1],
            fixed_snapshot=fixed_snapshot,
            fixed_target=fixed_target,
            fixed=fixed,
        )

    def _oracle(self, parameters: Mapping[str, Any]) -> Control:
        def control(lanes: Sequence[Task]) -> Controller:
            found = self.dataset.environment.oracle([parameters] * len(lanes))
            assert found is not None
            return found

        return control

    def _policy(self, task: Task, step: int, run: str) -> Control | None:
        """How a stored policy acts without noise in any task; None if the part holds no policy."""
        if self.dataset.part(task.index, step, run).identity.policy is None:
            return None
        snapshot, environment = self.dataset.snapshot(task.index, step, run), self.dataset.environment
        believed = first_observation(environment, task) if self._hidden.any() else np.zeros(len(self._hidden))

        def control(lanes: Sequence[Task]) -> Controller:
            acting = snapshot.controller(environment, [task.parameters] * len(lanes))
            return DeterministicController(BelievingController(acting, self._hidden, believed))

        return control


PACKAGES = ("numpy", "tcmrl", "torch")
"""Whose versions the returns depend on, beside the environment's own."""


def dataset_controls(dataset: Dataset, *, report: ProgressCallback = ignore_progress) -> Controls:
    """The controls of a dataset, measured if they were not before.

    Where the cache cannot be written they are measured every time.

    Raises:
        TrainingError: the dataset has no training or no test task.
        CheckpointError: the kept file is damaged; the message names it.

    Example:
        >>> dataset_controls(tcmrl_data.open_dataset("data/point-robot")).mean("fixed")  # doctest: +SKIP
    """
    about = _about(dataset)
    file = controls_file(about)
    if file.is_file():
        return read_record(Controls, file, remedy="; delete it, and it is made again")
    measured = measure_controls(dataset, report=report)
    with contextlib.suppress(StorageError, OSError):  # costs time and nothing else
        make_folders(file.parent)
        write_record(file, measured)
    return measured


def controls_file(about: Controls) -> Path:
    """Where controls of this heading are kept."""
    key = digest(about.model_dump(mode="json"))
    return cache_folder() / "controls" / f"{about.environment.replace('/', '-')}-{key[:32]}.json"


def measure_controls(dataset: Dataset, *, report: ProgressCallback = ignore_progress) -> Controls:
    """As `dataset_controls`, without the kept file."""
    if not dataset.train_tasks or not dataset.test_tasks:
        raise TrainingError(f"{dataset.path} has no training or no test task; build both for controls")
    tests, bench = dataset.test_tasks, ControlBench(dataset, report)
    nothing: list[float | None] = [None] * len(tests)
    try:
        snapshot, policy = bench.fixed_snapshot()
        target = bench.fixed_target()
        by_snapshot = nothing if policy is None else bench.returns(tests, policy, TEST_EPISODES)
        by_target = nothing if target is None else bench.returns(tests, bench.oracle(target), TEST_EPISODES)
        is_target = target and (snapshot is None or target.train_return >= snapshot.train_return)
        fixed = by_target if is_target else by_snapshot
        tasks = [
            bench.task_controls(
                task, fixed_snapshot=snapshot_return, fixed_target=target_return, fixed=better
            )
            for task, snapshot_return, target_return, better in zip(
                tests, by_snapshot, by_target, fixed, strict=True
            )
        ]
    finally:
        bench.close()
    return _about(dataset).model_copy(
        update={"fixed_snapshot": snapshot, "fixed_target": target, "tasks": tuple(tasks)}
    )


def _about(dataset: Dataset) -> Controls:
    """The heading of a dataset's controls: what they are a function of."""
    return Controls(
        environment=dataset.name,
        dataset_root=dataset.manifest.root,
        splits={task.index: task.split for task in dataset.tasks},
        versions={name: importlib.metadata.version(name) for name in PACKAGES},
        fingerprint=dataset.environment.fingerprint(),
    )
