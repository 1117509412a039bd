"""The collection of CSRO (Gao et al., 2023): no context before there are data."""

from collections.abc import Sequence
from functools import partial
from typing import final

import numpy as np

from tcmrl_algo.evaluation.arena import Arena, FloatArray
from tcmrl_algo.evaluation.protocols.base import Adaptation, Protocol
from tcmrl_data import Controller, LaneTransition, Task, Trajectory


@final
class NonPriorProtocol(Protocol):
    """Acts uniformly for the first half of all steps, then by the policy under all earlier episodes.

    The half is counted in steps, so that an odd number of episodes has one that changes in the middle; it
    acts on the context of the episodes before it. A single episode is uniform. Every method collects in this
    way, whatever its own exploration is.

    Deviations from the published code: the policy acts without noise, as under `paper`; it has the context of
    the episodes so far where the code waits with z = 0 for a number of evaluations; there are no episodes of
    evaluation between those of exploration, and all of the latter count and make the final context, where the
    code runs as many again beside the stated budget and does not use the last. An episode that ends early
    takes its full length of steps. The paper's Algorithm 2 infers the context anew after every step, the code
    after every episode, as here.
    """

    name = "non_prior"
    repeated = True

    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
        episodes, horizon = arena.settings.episodes, arena.dataset.environment.settings.horizon
        collected: list[list[Trajectory]] = [[] for _ in tasks]
        for episode in range(episodes):
            uniform_steps = num_uniform_steps(episode, episodes=episodes, horizon=horizon)
            if uniform_steps == horizon:
                trajectories = arena.uniform(tasks, episode=episode)
            else:
                start = partial(UniformStart, steps=uniform_steps)
                trajectories = arena.adapted(tasks, collected, episode=episode, around=start)
            for lane, trajectory in zip(collected, trajectories, strict=True):
                lane.append(trajectory)
        return [
            Adaptation([trajectory.undiscounted_return for trajectory in lane], [lane]) for lane in collected
        ]


def num_uniform_steps(episode: int, *, episodes: int, horizon: int) -> int:
    """How many steps an episode begins uniformly, so that half of all are; all steps of the first episode."""
    if episode == 0:
        return horizon
    return min(max(episodes * horizon // 2 - episode * horizon, 0), horizon)


@final
class UniformStart(Controller):
    """Uniform actions for the first steps of a rollout, then those of another controller."""

    def __init__(self, controller: Controller, *, steps: int) -> None:
        self.view = controller.view
        self._controller, self._steps, self._done = controller, steps, 0

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        uniform = generator.uniform(-1.0, 1.0, (self._steps, action_dim)).astype(np.float32)
        later = self._controller.draw_noise(generator, num_steps - self._steps, action_dim)
        return np.concatenate([uniform, later])

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        return noise if self._done < self._steps else self._controller.act(observations, noise)

    def observe(self, transition: LaneTransition) -> None:
        self._done += 1
        self._controller.observe(transition)
