"""IDAQ's protocol: collects episodes with the contexts of training tasks."""

from collections.abc import Sequence
from typing import final

import numpy as np

from tcmrl_algo.adaptation.arena import Arena, Context
from tcmrl_algo.adaptation.protocols.base import Adaptation, Protocol
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
