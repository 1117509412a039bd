"""Contexts from stored trajectories, as offline meta-RL papers evaluate."""

from collections.abc import Sequence
from typing import final

from tcmrl_algo.adaptation.arena import Arena
from tcmrl_algo.adaptation.protocols.base import Adaptation, Protocol
from tcmrl_data import Task


@final
class OfflineProtocol(Protocol):
    """Contexts from the test tasks' stored trajectories, drawn anew for every episode."""

    name = "offline"

    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
        draws = range(arena.settings.episodes)
        contexts = [[arena.stored(task, draw=draw) for draw in draws] for task in tasks]
        episodes = [
            arena.adapted(tasks, [of_task[draw] for of_task in contexts], episode=draw) for draw in draws
        ]
        return [
            Adaptation([episode[lane].undiscounted_return for episode in episodes], contexts[lane])
            for lane in range(len(tasks))
        ]
