"""The environment loop of all rollouts, of behavior policies in builds and learned policies in evaluation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.base import Environment, Lanes, Task
from tcmrl_data.envs.controller import BoolArray, Controller, FloatArray, LaneTransition, Trajectory

STEP_ARRAYS: Mapping[str, type[np.generic]] = {
    "actions": np.float32,
    "rewards": np.float32,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "active": np.bool_,
}
"""Arrays of a transition that are recorded, and their dtypes."""


def roll_out(
    environment: Environment,
    lanes: Lanes,
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
        controller: acts for all lanes and observes every step.
        reset_seeds: one per lane.
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


def hidden_entries(environment: Environment) -> BoolArray:
    """The entries of full observations that the stored view hides, (observation_dim,) bool."""
    shown = np.ones(environment.observation_dim)
    found: BoolArray = environment.stored_view(shown) != shown
    return found


def first_observation(environment: Environment, task: Task) -> FloatArray:
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
