"""Where episodes of several tasks are run, and what a protocol may ask for."""

from collections.abc import Callable, Sequence
from typing import final

import numpy as np
import numpy.typing as npt

from tcmrl_algo.algorithms.core.method import Algorithm, Capabilities
from tcmrl_algo.algorithms.core.problem import TaskParameters
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_data import (
    Controller,
    Dataset,
    Environment,
    Lanes,
    Purpose,
    Task,
    TrainingError,
    Trajectory,
    UniformController,
    keyed_generator,
    keyed_seed,
    roll_out,
)

MOST_LANES = 50
"""Most episodes that are stepped together; this many Meta-World lanes take 1 GB and 8 s to create."""

KEPT_BYTES = 2 * 2**30
"""Most memory of simulators that are kept for the next episodes of the same tasks."""


@final
class LaneStage:
    """Runs one episode per lane, at most MOST_LANES at a time; a lane's seeds are keyed by task and position.

    Args:
        seed: under which all seeds of episodes are keyed.
    """

    def __init__(self, environment: Environment, *, seed: int, reset: Purpose, noise: Purpose) -> None:
        self._environment, self._seed = environment, seed
        self._reset, self._noise = reset, noise
        self._lanes: dict[tuple[int, ...], Lanes] = {}

    def run(
        self,
        tasks: Sequence[Task],
        control: Callable[[slice], Controller],
        *,
        episode: int,
        done: Callable[[int], None],
    ) -> list[Trajectory]:
        """One episode per lane; lanes may repeat tasks.

        Args:
            control: the controller of some of the lanes.
            episode: part of the seeds' keys.
            done: called with the number of episodes that ended.
        """
        name, trajectories = self._environment.name, list[Trajectory]()
        for start in range(0, len(tasks), MOST_LANES):
            chunk = slice(start, start + MOST_LANES)
            keys = [(task.index, episode, start + lane) for lane, task in enumerate(tasks[chunk])]
            trajectories += roll_out(
                self._environment,
                self._lanes_of(tasks[chunk]),
                control(chunk),
                reset_seeds=[
                    keyed_seed(self._seed, name, task, self._reset, *place) for task, *place in keys
                ],
                noise=[keyed_generator(self._seed, name, task, self._noise, *place) for task, *place in keys],
            )
            done(len(keys))
        return trajectories

    def close(self) -> None:
        """Closes all lanes."""
        while self._lanes:
            self._lanes.popitem()[1].close()

    def _lanes_of(self, tasks: Sequence[Task]) -> Lanes:
        """Lanes of the tasks. They are kept, because episodes repeat tasks; the oldest give way."""
        key, environment = tuple(task.index for task in tasks), self._environment
        if key not in self._lanes:
            kept = KEPT_BYTES // max(1, environment.simulator_bytes) - len(key)
            while self._lanes and sum(map(len, self._lanes)) > kept:
                self._lanes.pop(next(iter(self._lanes))).close()
            self._lanes[key] = environment.lanes([task.parameters for task in tasks])
        return self._lanes[key]


FloatArray = npt.NDArray[np.floating]

Context = Sequence[Trajectory]
"""Trajectories that a policy adapts to; an empty context is the prior of a method that has one."""

ProgressCallback = Callable[[str, int, int], None]
"""Called with the name of a stage, the episodes done, and their total number."""


def ignore_progress(stage: str, done: int, total: int) -> None:
    """Ignores progress."""


@final
class Arena:
    """Runs episodes of test tasks, stepped together; every episode has its own keyed seeds.

    Args:
        settings: the table `[training.run]`.
        capabilities: the method's; whether it needs trajectories, and may observe task parameters.
        seed: the run's seed, from which the seeds of resets, noise and drawn contexts derive.
    """

    def __init__(
        self,
        dataset: Dataset,
        algorithm: Algorithm,
        settings: RunSettings,
        *,
        capabilities: Capabilities,
        seed: int,
        report: ProgressCallback = ignore_progress,
    ) -> None:
        self.dataset, self.settings = dataset, settings
        self._algorithm, self._seed, self._report = algorithm, seed, report
        self._capabilities = capabilities
        self._parameters = TaskParameters(dataset.train_tasks) if capabilities.privileged else None
        self._stage, self._done, self._total = "", 0, 0
        self._lanes = LaneStage(
            dataset.environment,
            seed=seed,
            reset=Purpose.EVALUATION_RESET,
            noise=Purpose.EVALUATION_NOISE,
        )
        self._stored: dict[int, list[Trajectory]] = {}

    def begin(self, stage: str, total: int) -> None:
        """Starts a stage of progress reports."""
        self._stage, self._done, self._total = stage, 0, total

    def adapted(
        self,
        tasks: Sequence[Task],
        contexts: Sequence[Context],
        *,
        episode: int,
        around: Callable[[Controller], Controller] | None = None,
    ) -> list[Trajectory]:
        """One episode per lane, by the policy adapted to the lane's context; lanes may repeat tasks.

        Args:
            around: makes the controller that acts from the adapted one.

        Raises:
            TrainingError: an empty context, for a method that needs trajectories.
        """
        self._check_contexts(tasks, contexts)

        def control(lanes: slice) -> Controller:
            adapted = self._adapt(tasks[lanes], contexts[lanes])
            return adapted if around is None else around(adapted)

        return self._lanes.run(tasks, control, episode=episode, done=self._count)

    def uniform(self, tasks: Sequence[Task], *, episode: int) -> list[Trajectory]:
        """One episode per lane by uniform actions, whatever the method's exploration is."""
        return self._lanes.run(tasks, lambda lanes: UniformController(), episode=episode, done=self._count)

    def explored(
        self, tasks: Sequence[Task], collected: Sequence[Context], *, episode: int
    ) -> list[Trajectory]:
        """One episode per lane by the exploration of the method, which is uniform actions by default."""

        def control(lanes: slice) -> Controller:
            return self._algorithm.explore(collected[lanes])

        return self._lanes.run(tasks, control, episode=episode, done=self._count)

    def stored(self, task: Task, *, draw: int) -> Context:
        """Draws `offline_trajectories` stored trajectories of a task without replacement."""
        if task.index not in self._stored:
            snapshots = self.settings.context_snapshots or self.settings.snapshots
            selection = self.dataset.select(tasks=[task.index], snapshots=snapshots)
            self._stored[task.index] = selection.trajectories(task.index)
        stored = self._stored[task.index]
        number = min(self.settings.offline_trajectories, len(stored))
        random = keyed_generator(self._seed, self.dataset.name, task.index, Purpose.EVALUATION_CONTEXT, draw)
        return [stored[index] for index in random.choice(len(stored), number, replace=False)]

    def candidates(self, task: Task, *, episode: int, lane: int) -> list[Task]:
        """Draws `candidates` training tasks with replacement, anew for every episode of every lane."""
        training = self.dataset.train_tasks
        key = (self._seed, self.dataset.name, task.index, Purpose.EVALUATION_CANDIDATES, episode, lane)
        drawn = keyed_generator(*key).choice(len(training), self.settings.candidates)
        return [training[index] for index in drawn]

    def latents(self, contexts: Sequence[Context]) -> FloatArray:
        """Contexts as vectors (contexts, latent); of no dimension if the method has none."""
        found = self._algorithm.latents(contexts)
        return np.zeros((len(contexts), 0)) if found is None else found.cpu().numpy()

    def close(self) -> None:
        """Closes all lanes."""
        self._lanes.close()

    def _count(self, episodes: int) -> None:
        self._done += episodes
        self._report(self._stage, self._done, self._total)

    def _check_contexts(self, tasks: Sequence[Task], contexts: Sequence[Context]) -> None:
        if not self._capabilities.needs_trajectories:
            return
        for task, context in zip(tasks, contexts, strict=True):
            if not context:
                raise TrainingError(
                    f"{self.settings.algorithm} cannot adapt to task {task.index} without a trajectory, but "
                    f"protocol {self.settings.protocol} gave none; set run.random_episodes to 1 or more, "
                    "or choose another --protocol"
                )

    def _adapt(self, tasks: Sequence[Task], contexts: Sequence[Context]) -> Controller:
        """The adapted policy; only a privileged method gets the task parameters."""
        if self._parameters is None:
            return self._algorithm.adapt(contexts)
        return self._algorithm.adapt(contexts, privileged=self._parameters(tasks))
