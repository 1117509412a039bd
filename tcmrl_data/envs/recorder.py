"""Recording of transitions as trajectories, for rollouts and for controllers."""

from collections.abc import Mapping
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.controller import Transition
from tcmrl_data.envs.trajectory import Trajectory

KINDS: Mapping[str, type[np.generic]] = {
    "actions": np.float32,
    "rewards": np.float32,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "active": np.bool_,
}
"""Recorded arrays of a transition and their dtypes."""


@final
class Recorder:
    """Collects the transitions of one episode per lane in memory; `DatasetRecorder` writes a dataset.

    Example:
        >>> import numpy as np
        >>> zeros, active = np.zeros((2, 3)), np.array([True, True])
        >>> step = Transition(zeros, zeros[:, :1], np.ones(2), zeros, ~active, ~active, active)
        >>> recorder = Recorder()
        >>> recorder.record(step)
        >>> [len(trajectory) for trajectory in recorder.trajectories()]
        [1, 1]
    """

    def __init__(self) -> None:
        self._observations: list[npt.NDArray[np.float32]] = []
        self._steps: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in KINDS}
        self._extras: dict[str, list[npt.NDArray[Any]]] = {}

    def record(
        self, transition: Transition, extras: Mapping[str, npt.NDArray[np.generic]] | None = None
    ) -> None:
        """Adds a copy of one step of all lanes.

        Args:
            transition: the step.
            extras: further arrays of shape (lanes,), with the same names in every step.
        """
        if not self._observations:
            self._observations.append(transition.observations.astype(np.float32))
        self._observations.append(transition.next_observations.astype(np.float32))
        for name, kind in KINDS.items():
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
