"""Rollouts: trajectories, the controllers that choose actions, and the one loop that steps environments."""

import abc
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.errors import TrajectoryError

if TYPE_CHECKING:
    from tcmrl_data.envs.base import Environment, Lanes, Task

FloatArray = npt.NDArray[np.floating]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T steps of one episode with T + 1 observations.

    Attributes:
        observations: (T + 1, observation_dim); the last one follows the last action.
        actions: (T, action_dim) in [-1, 1], as executed.
        rewards: (T,), for the state after the step.
        terminated: (T,) bool; True if the task ended the episode at this step.
        truncated: (T,) bool; True if a time limit ended the episode at this step.
        extras: further per-step arrays of shape (T,), such as `success`.

    Raises:
        TrajectoryError: the lengths or ranks of the arrays do not match; the message states both.

    Example:
        >>> import numpy as np
        >>> flags = np.zeros(3, dtype=bool)
        >>> trajectory = Trajectory(np.zeros((4, 2)), np.zeros((3, 1)), np.ones(3), flags, flags)
        >>> len(trajectory), trajectory.undiscounted_return
        (3, 3.0)
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    extras: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        steps = len(self.actions)
        ranks = {"observations": 2, "actions": 2, "rewards": 1, "terminated": 1, "truncated": 1}
        for name, rank in ranks.items():
            array = getattr(self, name)
            if array.ndim != rank:
                raise TrajectoryError(f"{name} must have {rank} dimensions, got shape {array.shape}")
        if len(self.observations) != steps + 1:
            raise TrajectoryError(
                f"observations must hold one row more than actions: {len(self.observations)} for {steps}"
            )
        for name in ("rewards", "terminated", "truncated"):
            if len(getattr(self, name)) != steps:
                raise TrajectoryError(f"{name} has {len(getattr(self, name))} steps, actions have {steps}")
        for name, array in self.extras.items():
            if array.shape != (steps,):
                raise TrajectoryError(f"{name} has shape {array.shape}, expected ({steps},)")

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def undiscounted_return(self) -> float:
        """Sum of the rewards, computed in double precision."""
        return float(np.sum(self.rewards, dtype=np.float64))


ObservationView = Literal["stored", "full"]
"""`stored`: the observations in the dataset. `full`: with the values that datasets hide, such as the goal."""


@dataclass(frozen=True)
class LaneTransition:
    """One step of all lanes, with observations in the controller's view.

    Rows of inactive lanes repeat the last observation and have reward zero.

    Attributes:
        observations: (lanes, observation_dim), before the step.
        actions: (lanes, action_dim) float32 in [-1, 1], as executed.
        rewards: (lanes,), for the state after the step.
        next_observations: (lanes, observation_dim), after the step.
        terminated: (lanes,) bool; True if the task ended the episode.
        truncated: (lanes,) bool; True if a time limit ended the episode.
        active: (lanes,) bool; False if the lane's episode ended before this step.
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    next_observations: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    active: BoolArray


class Controller(abc.ABC):
    """Chooses actions for a batch of lanes; the interface of all policies in rollouts.

    A controller with state serves one rollout, which is one episode in every lane.
    """

    view: ObservationView = "stored"
    """Which observations the controller receives."""

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        """Draws the noise of one episode, (num_steps, action_dim) float32; standard normal by default."""
        return generator.standard_normal((num_steps, action_dim), dtype=np.float32)

    @abc.abstractmethod
    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        """Actions (lanes, action_dim) for observations (lanes, observation_dim) and this step's noise."""

    def observe(self, transition: LaneTransition) -> None:
        """Receives every step after it is executed; does nothing by default.

        For controllers that adapt within an episode. `tcmrl_data.Recorder` turns transitions into
        trajectories.
        """


@final
class UniformController(Controller):
    """Uniform actions in [-1, 1]."""

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        return generator.uniform(-1.0, 1.0, (num_steps, action_dim)).astype(np.float32)

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        return noise


@final
class PlaybackController(Controller):
    """Plays stored actions for one rollout: (steps, action_dim) per lane, then zeros."""

    def __init__(self, actions: Iterable[FloatArray]) -> None:
        self._actions, self._step = list(actions), 0

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        step, self._step = self._step, self._step + 1
        nothing = np.zeros(noise.shape[1], dtype=np.float32)
        return np.stack([actions[step] if step < len(actions) else nothing for actions in self._actions])


class _Wrapper(Controller):
    """Base class of controllers that change another one's observations, noise or actions."""

    def __init__(self, controller: Controller) -> None:
        self.view = controller.view
        self._controller = controller

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        return self._controller.draw_noise(generator, num_steps, action_dim)

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        return self._controller.act(observations, noise)

    def observe(self, transition: LaneTransition) -> None:
        self._controller.observe(transition)


@final
class NoisyController(_Wrapper):
    """Adds normal noise to another controller's actions, for one rollout, which clips the sum to [-1, 1]."""

    def __init__(
        self, controller: Controller, sigma: float, generators: Iterable[np.random.Generator]
    ) -> None:
        super().__init__(controller)
        self._sigma, self._generators = sigma, iter(generators)

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        own = super().draw_noise(generator, num_steps, action_dim)
        more = next(self._generators).standard_normal((num_steps, action_dim), dtype=np.float32)
        return np.concatenate([own, more], axis=1)

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        own, more = np.split(noise, 2, axis=1)
        return super().act(observations, own) + np.float32(self._sigma) * more


@final
class BelievingController(_Wrapper):
    """Replaces what a controller observes of the task by the values of another task.

    Args:
        hidden: (observation_dim,) bool, the entries of full observations to replace.
        values: (observation_dim,), their new values.
    """

    def __init__(self, controller: Controller, hidden: BoolArray, values: FloatArray) -> None:
        super().__init__(controller)
        self._hidden, self._values = hidden, values

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        if self.view == "full":
            observations = np.where(self._hidden, self._values, observations)
        return super().act(observations, noise)


@final
class DeterministicController(_Wrapper):
    """Sets another controller's noise to zero; a Gaussian policy then takes its most likely action."""

    def draw_noise(self, generator: np.random.Generator, num_steps: int, action_dim: int) -> FloatArray:
        return np.zeros((num_steps, action_dim), dtype=np.float32)


STEP_ARRAYS: Mapping[str, type[np.generic]] = {
    "actions": np.float32,
    "rewards": np.float32,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "active": np.bool_,
}
"""Arrays of a transition that are recorded, and their dtypes."""


def roll_out(
    environment: "Environment",
    lanes: "Lanes",
    controller: Controller,
    *,
    reset_seeds: Sequence[int],
    noise: Sequence[np.random.Generator],
) -> list[Trajectory]:
    """Rolls out one episode per lane, with one batched call of the controller per step.

    The controller receives all lanes at every step, including finished ones, because the results of a
    batched network call depend on the batch size in their last bits. Actions are clipped to [-1, 1] before
    they are executed and stored. The returned observations are the environment's stored view.

    Args:
        environment: gives the horizon, the action size and the stored view.
        lanes: L lanes, which may be used for several rollouts.
        noise: one generator per lane; the noise of a whole episode is drawn before it starts.

    Returns:
        L trajectories in lane order; float32 observations, actions and rewards.
    """
    horizon, action_dim = environment.settings.horizon, environment.action_dim
    draws = np.stack([controller.draw_noise(generator, horizon, action_dim) for generator in noise])
    recorder = Recorder()
    active = np.ones(lanes.num_lanes, dtype=bool)
    full = lanes.reset(reset_seeds)
    stored = environment.stored_view(full)
    for t in range(horizon):
        seen = full if controller.view == "full" else stored
        actions = np.clip(controller.act(seen, draws[:, t]), -1.0, 1.0).astype(np.float32)
        step = lanes.step(actions, active)
        next_stored = environment.stored_view(step.observations)
        transition = LaneTransition(
            stored, actions, step.rewards, next_stored, step.terminated, step.truncated, active
        )
        extras = {name: step.extras[name].astype(kind) for name, kind in environment.extras.items()}
        recorder.record(transition, extras)
        if controller.view == "full":
            transition = dataclasses.replace(
                transition, observations=full, next_observations=step.observations
            )
        controller.observe(transition)
        full, stored = step.observations, next_stored
        active = active & ~(step.terminated | step.truncated)
        if not active.any():
            break
    return recorder.trajectories()


def hidden_entries(environment: "Environment") -> BoolArray:
    """The entries of full observations that the stored view hides, (observation_dim,) bool."""
    shown = np.ones(environment.observation_dim)
    found: BoolArray = environment.stored_view(shown) != shown
    return found


def first_observation(environment: "Environment", task: "Task") -> FloatArray:
    """The task's full observation after a reset, (observation_dim,); its hidden entries describe the task."""
    lanes = environment.lanes([task.parameters])
    try:
        found: FloatArray = lanes.reset([0])[0]
        return found
    finally:
        lanes.close()


@final
class Recorder:
    """Collects the transitions of one episode per lane in memory; `DatasetRecorder` writes a dataset.

    Example:
        >>> import numpy as np
        >>> zeros, active = np.zeros((2, 3)), np.array([True, True])
        >>> step = LaneTransition(zeros, zeros[:, :1], np.ones(2), zeros, ~active, ~active, active)
        >>> recorder = Recorder()
        >>> recorder.record(step)
        >>> [len(trajectory) for trajectory in recorder.trajectories()]
        [1, 1]
    """

    def __init__(self) -> None:
        self._observations: list[npt.NDArray[np.float32]] = []
        self._steps: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in STEP_ARRAYS}
        self._extras: dict[str, list[npt.NDArray[Any]]] = {}

    def record(
        self, transition: LaneTransition, extras: Mapping[str, npt.NDArray[np.generic]] | None = None
    ) -> None:
        """Adds a copy of one step; `extras` are arrays (lanes,) with the same names in every step."""
        if not self._observations:
            self._observations.append(transition.observations.astype(np.float32))
        self._observations.append(transition.next_observations.astype(np.float32))
        for name, kind in STEP_ARRAYS.items():
            self._steps[name].append(getattr(transition, name).astype(kind))
        for name, array in (extras or {}).items():
            self._extras.setdefault(name, []).append(array.copy())

    def trajectories(self) -> list[Trajectory]:
        """The steps recorded so far, one float32 trajectory per lane; empty before the first step.

        A lane's trajectory ends with its episode.
        """
        if not self._observations:
            return []
        observations = np.stack(self._observations, axis=1)
        steps = {name: np.stack(arrays, axis=1) for name, arrays in self._steps.items()}
        extras = {name: np.stack(arrays, axis=1) for name, arrays in self._extras.items()}
        return [
            Trajectory(
                observations[lane, : length + 1],
                steps["actions"][lane, :length],
                steps["rewards"][lane, :length],
                steps["terminated"][lane, :length],
                steps["truncated"][lane, :length],
                {name: array[lane, :length] for name, array in extras.items()},
            )
            for lane, length in enumerate(steps["active"].sum(axis=1))
        ]
