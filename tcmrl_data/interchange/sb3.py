"""A Stable-Baselines3 replay buffer filled from a selection."""

from typing import TYPE_CHECKING

import numpy as np
from gymnasium.spaces import Box

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.interchange.exporting import transitions

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import ReplayBuffer


def to_sb3_buffer(selection: Selection, task: int, *, device: str = "cpu") -> "ReplayBuffer":
    """All selected transitions of one task.

    The buffer handles time limits: a batch's `dones` are 1 where the task itself ended the episode, and 0
    where a time limit did, so that the value of the last observation counts.

    Raises:
        SelectionError: the selection does not hold the task, or no transition of it.

    Example:
        >>> from tcmrl_data.interchange.sb3 import to_sb3_buffer
        >>> model.replay_buffer = to_sb3_buffer(dataset.select(snapshots="last"), task=7)  # doctest: +SKIP
        >>> model.train(gradient_steps=100)  # doctest: +SKIP
    """
    from stable_baselines3.common.buffers import ReplayBuffer

    trajectories = selection.trajectories(task) if task in selection.parts else []
    if not any(map(len, trajectories)):
        raise SelectionError(
            f"{selection.dataset.path}: the selection holds no transition of task {task}; it has the tasks "
            f"{sorted(selection.parts)}"
        )
    rows = transitions(trajectories)
    environment = selection.dataset.environment
    buffer = ReplayBuffer(
        len(rows["rewards"]),
        Box(-np.inf, np.inf, (environment.observation_dim,), np.float32),
        Box(-1.0, 1.0, (environment.action_dim,), np.float32),
        device=device,
    )
    for name in ("observations", "next_observations", "actions", "rewards"):
        getattr(buffer, name)[:, 0] = rows[name]
    buffer.dones[:, 0] = rows["terminated"] | rows["truncated"]
    buffer.timeouts[:, 0] = rows["truncated"] & ~rows["terminated"]
    buffer.full = True
    return buffer
