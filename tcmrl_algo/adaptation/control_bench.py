"""Runs the controls of a dataset: its stored policies, the oracle, and those of both that never adapt."""

from collections.abc import Callable, Mapping, Sequence
from statistics import fmean
from typing import Any, final

import numpy as np

from tcmrl_algo.adaptation.arena import ProgressCallback
from tcmrl_algo.adaptation.control_records import FixedSnapshot, FixedTarget, TaskControls
from tcmrl_algo.adaptation.fixed import best_target
from tcmrl_algo.adaptation.lane_stage import LaneStage
from tcmrl_data import (
    BelievingController,
    Controller,
    Dataset,
    DeterministicController,
    Purpose,
    Task,
    first_observation,
    hidden_entries,
)
from tcmrl_data.foundation.seeding import evenly_spread

TEST_EPISODES = 5
"""Episodes per policy and test task; one per policy and training task choose the fixed policies."""

SCREENING_TASKS, FINALISTS = 10, 5
"""Training tasks in which all candidates for a fixed policy are tried, and candidates tried in all tasks."""

Control = Callable[[Sequence[Task]], Controller]
"""How a policy acts in lanes of some tasks."""


@final
class ControlBench:
    """Runs policies in the tasks of a dataset.

    Args:
        dataset: with its environment, tasks and stored policies.
        report: called with the stage, the episodes done and their total number.
    """

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
