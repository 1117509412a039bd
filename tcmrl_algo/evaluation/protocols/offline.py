"""The usual protocol of offline meta-RL papers: contexts are stored trajectories of the tasks themselves."""

from collections.abc import Sequence
from typing import final

from tcmrl_algo.evaluation.arena import Arena
from tcmrl_algo.evaluation.protocols.base import Adaptation, Protocol
from tcmrl_data import Task


class OfflineProtocol(Protocol):
    """Draws a context from the stored trajectories of the task for every episode."""

    name = "offline"

    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
        draws = range(arena.settings.episodes)
        contexts = [[arena.stored(task, draw=draw) for draw in draws] for task in tasks]
        episodes = [
            arena.adapted(tasks, [task_contexts[draw] for task_contexts in contexts], episode=draw)
            for draw in draws
        ]
        return [
            Adaptation([episode[lane].undiscounted_return for episode in episodes], contexts[lane])
            for lane in range(len(tasks))
        ]


@final
class OfflineTrainProtocol(OfflineProtocol):
    """The same in training tasks: a policy that is no better there than in test tasks is not overfitted."""

    name = "offline_train"
    split = "train"
