"""IDAQ's protocol, ours without random draws and the published one: both try contexts of training tasks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from tcmrl_algo.evaluation.arena import Arena, Context, FloatArray
from tcmrl_algo.evaluation.protocols.base import Adaptation, Protocol
from tcmrl_data import Task, Trajectory


@final
class IdaqProtocol(Protocol):
    """Tries contexts of training tasks, and keeps the context of the episode with the highest return.

    Four fifths of the episodes try the contexts of evenly spaced training tasks, one per episode. The other
    episodes use the best episode so far as their context, and keep that context if the return is higher.

    Ours, without random draws. `idaq_literal` is the published procedure, which tries the most distant of
    randomly drawn training tasks, and then lets contexts grow by the best episodes.
    """

    name = "idaq"

    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
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


@dataclass(frozen=True)
class Belief:
    """What one lane believes about its task.

    Attributes:
        latent: the trajectories from which the policy's context is computed.
        collected: the episodes to which the next improvement is appended.
    """

    latent: Context
    collected: Context


@final
class IdaqLiteralProtocol(Protocol):
    """Searches the contexts of training tasks, then those of the best episodes.

    In the first `random_episodes` episodes, every lane draws `candidates` training tasks and tries the one
    whose context is farthest from the contexts that it tried before. The other episodes act on the context
    of the best episode. An episode with a higher return is appended to that context. After any other episode
    the lane returns to the context under which the best episode was run, and to the episodes collected then.
    The last episode, and the final ones, act on the context under which the best episode was run.

    Deviations: contexts of training tasks are `offline_trajectories` stored trajectories, as they are for
    `offline`; the result is the mean of `final_episodes` further episodes, not the last episode's return.
    """

    name = "idaq_literal"
    repeated = True

    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
        episodes = arena.settings.episodes
        num_tried = min(max(1, arena.settings.random_episodes), episodes)
        lanes = [Lane() for _ in tasks]
        stored = {task.index: arena.stored(task, draw=0) for task in arena.dataset.train_tasks}
        latents = dict(zip(stored, arena.latents(list(stored.values())), strict=True))
        for episode in range(episodes):
            for number, (lane, task) in enumerate(zip(lanes, tasks, strict=True)):
                if episode < num_tried:
                    drawn = arena.candidates(task, episode=episode, lane=number)
                    chosen = drawn[farthest([latents[one.index] for one in drawn], lane.tried)]
                    lane.try_training_task(stored[chosen.index], latents[chosen.index])
                elif episode == num_tried:
                    lane.infer()
                if episode == episodes - 1 and episode > 0:
                    lane.return_to_best()
            trajectories = arena.adapted(tasks, [lane.belief.latent for lane in lanes], episode=episode)
            for lane, trajectory in zip(lanes, trajectories, strict=True):
                lane.add(trajectory, searching=episode < num_tried)
        return [Adaptation(lane.returns, [lane.best_belief.latent]) for lane in lanes]


def farthest(candidates: Sequence[FloatArray], tried: Sequence[FloatArray]) -> int:
    """Position of the candidate whose smallest mean squared distance to the tried contexts is largest.

    The first of equal candidates; without tried contexts, the first candidate.
    """
    if not tried or not candidates[0].size:
        return 0
    distances = np.square(np.stack(candidates)[:, None] - np.stack(tried)).mean(axis=-1)
    return int(distances.min(axis=1).argmax())


class Lane:
    """The search of one lane.

    Attributes:
        returns: of its episodes so far.
        tried: latent contexts of the training tasks that it tried.
        belief: under which the next episode is run.
        best_belief: under which the best episode was run.
    """

    def __init__(self) -> None:
        self.returns: list[float] = []
        self.tried: list[FloatArray] = []
        self.belief = self.best_belief = Belief([], [])
        self._best_return = -np.inf

    def try_training_task(self, context: Context, latent: FloatArray) -> None:
        """Runs the next episode under the context of a training task."""
        self.tried.append(latent)
        self.belief = Belief(context, [])

    def infer(self) -> None:
        """Runs the next episode under the context of the best episode."""
        self.belief = Belief(self.best_belief.collected, self.best_belief.collected)

    def return_to_best(self) -> None:
        """Runs the next episode under the context under which the best episode was run."""
        self.belief = self.best_belief

    def add(self, trajectory: Trajectory, *, searching: bool) -> None:
        """Takes in the episode that was run under `belief`."""
        value = trajectory.undiscounted_return
        self.returns.append(value)
        if value > self._best_return:
            self._best_return = value
            collected = [*self.belief.collected, trajectory]
            self.best_belief = Belief(self.belief.latent, collected) if searching else self.belief
            self.belief = Belief(collected, collected)
        elif not searching:
            self.return_to_best()
