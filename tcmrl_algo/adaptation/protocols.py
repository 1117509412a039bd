"""Three protocols of adaptation to test tasks; each ends in the trajectories that adapt the final policy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from tcmrl_algo.methods.problem import Algorithm
from tcmrl_algo.settings.run import Protocol, RunSettings
from tcmrl_data import (
    Controller,
    Dataset,
    Lanes,
    Purpose,
    Task,
    Trajectory,
    keyed_generator,
    keyed_seed,
    roll_out,
)

MOST_LANES = 50
"""Episodes stepped together; as many Meta-World lanes take 1 GB and 8 s to make."""

Context = Sequence[Trajectory]
Report = Callable[[str, int, int], None]
"""Called with a stage, episodes done and episodes to do."""


def ignore_progress(stage: str, done: int, total: int) -> None:
    """Reports nothing."""


@dataclass(frozen=True)
class Adaptation:
    """How one test task was adapted to.

    Attributes:
        returns: undiscounted return of each adaptation episode.
        contexts: what the final policy may be adapted by; several where the protocol draws several.
    """

    returns: list[float]
    contexts: list[Context]


@final
class Arena:
    """Runs episodes of test tasks, all stepped together, each with its own keyed seeds.

    Args:
        dataset: names environment and tasks, and holds stored trajectories.
        algorithm: the trained method.
        settings: `[training.run]`.
        seed: the run's; addresses resets, noise and drawn contexts.
        report: called with stage, episodes done and episodes to do, as episodes end.
    """

    def __init__(
        self,
        dataset: Dataset,
        algorithm: Algorithm,
        settings: RunSettings,
        *,
        seed: int,
        report: Report = ignore_progress,
    ) -> None:
        self.dataset, self.settings = dataset, settings
        self._algorithm, self._seed, self._report = algorithm, seed, report
        self._stage, self._done, self._total = "", 0, 0
        self._lanes: tuple[tuple[int, ...], Lanes] | None = None
        self._stored: dict[int, list[Trajectory]] = {}

    def begin(self, stage: str, total: int) -> None:
        """Names what the coming episodes are for, and their number, for progress reports."""
        self._stage, self._done, self._total = stage, 0, total

    def adapted(
        self, tasks: Sequence[Task], contexts: Sequence[Context], *, episode: int
    ) -> list[Trajectory]:
        """One episode per lane by the policy adapted to that lane's context; lanes may repeat tasks."""
        found: list[Trajectory] = []
        for start in range(0, len(tasks), MOST_LANES):
            lanes = slice(start, start + MOST_LANES)
            controller = self._algorithm.adapt(contexts[lanes])
            found += self._run(tasks[lanes], controller, episode=episode, first_lane=start)
        return found

    def explored(
        self, tasks: Sequence[Task], collected: Sequence[Context], *, episode: int
    ) -> list[Trajectory]:
        """One episode per lane by the method's exploration, uniform actions unless it has its own."""
        return self._run(tasks, self._algorithm.explore(collected), episode=episode, first_lane=0)

    def stored(self, task: Task, *, draw: int) -> Context:
        """Stored trajectories of a task, `offline_trajectories` of them, drawn without replacement."""
        if task.index not in self._stored:
            snapshots = self.settings.context_snapshots or self.settings.snapshots
            selection = self.dataset.select(tasks=[task.index], snapshots=snapshots)
            self._stored[task.index] = selection.trajectories(task.index)
        stored = self._stored[task.index]
        number = min(self.settings.offline_trajectories, len(stored))
        random = keyed_generator(self._seed, self.dataset.name, task.index, Purpose.EVALUATION_CONTEXT, draw)
        return [stored[index] for index in random.choice(len(stored), number, replace=False)]

    def close(self) -> None:
        """Frees the lanes."""
        if self._lanes is not None:
            self._lanes[1].close()
        self._lanes = None

    def _lanes_of(self, tasks: Sequence[Task]) -> Lanes:
        """Lanes of these tasks; the last ones are kept, since adaptation steps the same tasks again."""
        key = tuple(task.index for task in tasks)
        if self._lanes is None or self._lanes[0] != key:
            self.close()
            self._lanes = (key, self.dataset.environment.lanes([task.parameters for task in tasks]))
        return self._lanes[1]

    def _run(
        self, tasks: Sequence[Task], controller: Controller, *, episode: int, first_lane: int
    ) -> list[Trajectory]:
        environment, name = self.dataset.environment, self.dataset.name
        places = [(task.index, first_lane + lane) for lane, task in enumerate(tasks)]
        trajectories = roll_out(
            environment,
            self._lanes_of(tasks),
            controller,
            reset_seeds=[
                keyed_seed(self._seed, name, task, Purpose.EVALUATION_RESET, episode, lane)
                for task, lane in places
            ],
            noise=[
                keyed_generator(self._seed, name, task, Purpose.EVALUATION_NOISE, episode, lane)
                for task, lane in places
            ],
        )
        self._done += len(tasks)
        self._report(self._stage, self._done, self._total)
        return trajectories


def adapt_paper(arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
    """The paper's protocol (section 4.2): random episodes, then the policy under a growing context.

    Deviation: the policy acts by its most likely action in the second stage too, without noise.
    """
    settings = arena.settings
    num_random = min(settings.random_episodes, settings.episodes)
    collected: list[list[Trajectory]] = [[] for _ in tasks]
    for episode in range(settings.episodes):
        if episode < num_random:
            trajectories = arena.explored(tasks, collected, episode=episode)
        else:
            trajectories = arena.adapted(tasks, collected, episode=episode)
        for lane, trajectory in zip(collected, trajectories, strict=True):
            lane.append(trajectory)
    return [Adaptation([each.undiscounted_return for each in lane], [lane]) for lane in collected]


def adapt_offline(arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
    """Contexts from the test tasks' stored trajectories, drawn anew for every episode."""
    draws = range(arena.settings.episodes)
    contexts = [[arena.stored(task, draw=draw) for draw in draws] for task in tasks]
    episodes = [arena.adapted(tasks, [lane[draw] for lane in contexts], episode=draw) for draw in draws]
    return [
        Adaptation([episode[lane].undiscounted_return for episode in episodes], contexts[lane])
        for lane in range(len(tasks))
    ]


def adapt_idaq(arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
    """IDAQ's protocol: training tasks' contexts are tried first, the best-return episode's is kept.

    Four fifths of the episodes each try the context of one training task, evenly spaced among them. The
    rest try the context that the best episode so far itself shows, and keep it where it does better.
    """
    training, episodes = arena.dataset.train_tasks, arena.settings.episodes
    num_tried = min(len(training), max(1, episodes - max(1, episodes // 5)))
    chosen = np.linspace(0, len(training) - 1, num_tried).round().astype(int)
    candidates: list[Context] = [arena.stored(training[index], draw=0) for index in chosen]
    returns: list[list[float]] = [[] for _ in tasks]
    kept: list[Context] = [candidates[0] for _ in tasks]
    best: list[Trajectory | None] = [None for _ in tasks]
    for episode in range(episodes):
        if episode < num_tried:
            tried: list[Context] = [candidates[episode]] * len(tasks)
        else:
            tried = [[trajectory] if trajectory else [] for trajectory in best]
        trajectories = arena.adapted(tasks, tried, episode=episode)
        for lane, trajectory in enumerate(trajectories):
            if trajectory.undiscounted_return > max(returns[lane], default=-np.inf):
                kept[lane], best[lane] = tried[lane], trajectory
            returns[lane].append(trajectory.undiscounted_return)
    return [Adaptation(returns[lane], [kept[lane]]) for lane in range(len(tasks))]


PROTOCOLS: dict[Protocol, Callable[[Arena, Sequence[Task]], list[Adaptation]]] = {
    "paper": adapt_paper,
    "offline": adapt_offline,
    "idaq": adapt_idaq,
}
