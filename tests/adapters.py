"""Methods that adapt by hand-written rules, and the arena to adapt in, for the tests of adaptation."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from tcmrl_algo import Algorithm, Arena, Capabilities, Metrics
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_data import Batch, Controller, Dataset, LaneTransition, Recorder, Task, Trajectory

ANGLES = np.linspace(0.0, np.pi, 100)
GOALS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
"""Of the point robot's tasks."""


def goal_of(trajectory: Trajectory) -> np.ndarray:
    """The goal that explains the rewards of a trajectory."""
    distances = np.linalg.norm(GOALS[:, None] - trajectory.observations[None, 1:], axis=-1)
    found: np.ndarray = GOALS[np.abs(distances + trajectory.rewards).sum(axis=-1).argmin()]
    return found


class GoalController(Controller):
    """Walks to one goal per lane."""

    def __init__(self, goals: np.ndarray) -> None:
        self._goals = goals

    def act(self, observations: Any, noise: Any) -> Any:
        return np.clip((self._goals - observations) / 0.1, -1.0, 1.0)


class GoalReader(Algorithm):
    """Adapts perfectly: finds the goal that explains the rewards of the first trajectory.

    Attributes:
        seen: the number of trajectories that every call of `adapt` received, by lane.
    """

    def __init__(self) -> None:
        self.seen: list[list[int]] = []

    def loss(self, batch: Batch, step: int) -> tuple[Tensor, Metrics]:
        raise AssertionError("never trained")

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        assert privileged is None
        self.seen.append([len(lane) for lane in trajectories])
        return GoalController(np.array([goal_of(lane[0]) for lane in trajectories]))

    def tensors(self) -> dict[str, Tensor]:
        return {}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        pass


class GoalSeeker(GoalReader):
    """Adapts within an episode too: walks to the goal that its context shows, until rewards show another."""

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        self.seen.append([len(lane) for lane in trajectories])
        believed = [goal_of(lane[0]) if lane else np.array([0.0, 1.0]) for lane in trajectories]
        return SeekingController(np.array(believed))


class SeekingController(GoalController):
    """Walks to the goals that the previous episodes show."""

    def __init__(self, goals: np.ndarray) -> None:
        super().__init__(goals)
        self._recorder = Recorder()

    def observe(self, transition: LaneTransition) -> None:
        self._recorder.record(transition)
        self._goals = np.array([goal_of(episode) for episode in self._recorder.trajectories()])


def arena(
    dataset: Dataset, algorithm: Algorithm, *, capabilities: Capabilities | None = None, **settings: Any
) -> Arena:
    """An arena of seed 0."""
    capabilities = capabilities or Capabilities()
    return Arena(dataset, algorithm, RunSettings(**settings), capabilities=capabilities, seed=0)


def oracle(dataset: Dataset, task: Task) -> float:
    """The return of the oracle controller."""
    found = dataset.references(task.index).oracle
    assert found is not None
    return found
