"""The paper's protocol (section 4.2)."""

from collections.abc import Sequence
from typing import final

from tcmrl_algo.evaluation.arena import Arena
from tcmrl_algo.evaluation.protocols.base import Adaptation, Protocol
from tcmrl_data import Task, Trajectory


@final
class PaperProtocol(Protocol):
    """Collects episodes as the method explores, then those of the policy with all earlier ones as context.

    Methods explore by uniform actions, but for those that say otherwise.

    Deviation: in the second stage, too, the policy takes its most likely action, without noise. With
    `random_episodes = 0`, a method that needs no trajectories starts from its prior.
    """

    name = "paper"
    repeated = True

    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
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
        return [
            Adaptation([trajectory.undiscounted_return for trajectory in lane], [lane]) for lane in collected
        ]
