"""One episode as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.errors import TrajectoryError

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
