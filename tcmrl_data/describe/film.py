"""Stored episodes played again: every step is compared with the stored one, and pictures are taken."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.base import Camera, Environment, EnvironmentLanes, Picture
from tcmrl_data.envs.rollout import (
    Controller,
    FloatArray,
    LaneTransition,
    ObservationView,
    PlaybackController,
    Trajectory,
    roll_out,
)
from tcmrl_data.envs.simulation import check_chosen_open_gl
from tcmrl_data.foundation.errors import RenderingError, SelectionError, SimulationError
from tcmrl_data.foundation.seeding import Purpose, evenly_spread, keyed_seed
from tcmrl_data.parts.own_operations import operation_of
from tcmrl_data.store.tables import PartKey


@dataclass(frozen=True)
class StoredEpisode:
    """An episode, its place in its part, and the seed with which its task was reset."""

    key: PartKey
    number: int
    parameters: Mapping[str, Any]
    trajectory: Trajectory
    reset_seed: int

    def __str__(self) -> str:
        return f"{self.key}, episode {self.number}"


def find_episode(dataset: Dataset, key: PartKey, number: int) -> StoredEpisode:
    """Reads an episode.

    Raises:
        SelectionError: the dataset has no such part, or the part no such episode.
    """
    identity = dataset.part(*key).identity
    if identity.seed is None:
        raise RenderingError(
            f"{dataset.path}: the seeds of the episodes of {key} are not known, so that they cannot be "
            "played again; draw episodes of a dataset that was built, not imported or recorded"
        )
    trajectories = dataset.trajectories(*key)
    if number >= len(trajectories):
        raise SelectionError(
            f"{dataset.path}: {key} has {len(trajectories)} episodes; choose --episode below that"
        )
    (run,) = (run for run in dataset.manifest.runs if run.name == key.run)
    operation = operation_of(identity, str(dataset.file_of(key)))
    task, position = operation.seeded_as(key.task, number, run)
    seed = keyed_seed(identity.seed, dataset.name, task, Purpose.ROLLOUT_RESET, key.step, position)
    return StoredEpisode(key, number, dataset.task(key.task).parameters, trajectories[number], seed)


@dataclass(frozen=True)
class Frame:
    """A picture (height, width, 3) of an episode, and the steps before it with the sum of their rewards."""

    picture: Picture
    steps: int
    reward: float


def film(
    environment: Environment,
    episode: StoredEpisode,
    *,
    frames: int,
    width: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Frame]:
    """Plays an episode again and takes pictures, evenly spread from its start to its end.

    Args:
        width: of the pictures in pixels; their height is three quarters of it.

    Raises:
        RenderingError: the environment has no camera, or this machine cannot draw it.
        SimulationError: a step differs from the stored one; names the first such step.
    """
    steps = len(episode.trajectory)
    moments = evenly_spread(range(steps + 1), frames)
    if environment.simulator_bytes:
        check_chosen_open_gl()
    with contextlib.ExitStack() as stack:
        task = environment.make(episode.parameters, view="full")
        lanes = stack.enter_context(contextlib.closing(EnvironmentLanes(environment, [task])))
        camera = environment.camera(task, episode.parameters, width=width, height=3 * width // 4)
        if camera is None:
            raise RenderingError(
                f"environment {environment.name!r} has no picture; give its class a method `camera`"
            )
        stack.callback(camera.close)
        controller = _FilmingController(environment, episode, camera, set(moments), progress)
        roll_out(
            environment,
            lanes,
            controller,
            reset_seeds=[episode.reset_seed],
            noise=[np.random.default_rng(0)],  # drawn by every rollout, and not used
        )
        return controller.frames


@final
class _FilmingController(Controller):
    """Plays one stored episode, compares every step with it, and takes pictures at some moments."""

    view: ObservationView = "full"

    def __init__(
        self,
        environment: Environment,
        episode: StoredEpisode,
        camera: Camera,
        moments: set[int],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.frames: list[Frame] = []
        self._environment, self._episode, self._camera = environment, episode, camera
        self._moments, self._progress = moments, progress
        self._playback = PlaybackController([episode.trajectory.actions])
        self._seen: list[FloatArray] = []

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        if not self._seen:
            self._see(observations[0])
        return self._playback.act(observations, noise)

    def observe(self, transition: LaneTransition) -> None:
        stored, step = self._episode.trajectory, len(self._seen) - 1
        for name, there, here in (
            ("reward", stored.rewards[step], transition.rewards[0]),
            ("terminated", stored.terminated[step], transition.terminated[0]),
            ("truncated", stored.truncated[step], transition.truncated[0]),
        ):
            if not _equal(here, there):
                raise self._difference(name, step)
        self._see(transition.next_observations[0])

    def _see(self, observation: FloatArray) -> None:
        stored, step = self._episode.trajectory, len(self._seen)
        if not _equal(self._environment.stored_view(observation), stored.observations[step]):
            raise self._difference("observation", step)
        self._seen.append(observation.copy())
        if self._progress is not None:
            self._progress(step, len(stored))
        if step in self._moments:
            reward = float(np.sum(stored.rewards[:step], dtype=np.float64))
            self.frames.append(Frame(self._camera.picture(np.stack(self._seen)), step, reward))

    def _difference(self, what: str, step: int) -> SimulationError:
        return SimulationError(f"{self._episode}: does not replay, its {what} differs first at step {step}")


def _equal(here: FloatArray, there: FloatArray) -> bool:
    """Whether a simulated value is stored bit for bit; NaN equals NaN, and 0 differs from -0."""
    return here.astype(there.dtype).tobytes() == there.tobytes()
