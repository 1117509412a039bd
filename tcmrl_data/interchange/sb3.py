"""A Stable-Baselines3 replay buffer filled from a selection."""

from typing import TYPE_CHECKING

import numpy as np
from gymnasium.spaces import Box

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.foundation.errors import SelectionError

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import ReplayBuffer


def to_sb3_buffer(selection: Selection, task: int, *, device: str = "cpu") -> "ReplayBuffer":
    """All selected transitions of one task.

    The buffer handles time limits: a batch's `dones` are 1 where the task itself ended the episode, and 0
    where a time limit did, so that the value of the last observation counts.

    Args:
        selection: what to take.
        task: index of a selected task.
        device: where sampled batches go.

    Raises:
        SelectionError: the selection does not hold the task, or no transition of it.

    Example:
        >>> from tcmrl_data.interchange.sb3 import to_sb3_buffer
        >>> model.replay_buffer = to_sb3_buffer(dataset.select(snapshots="last"), task=7)  # doctest: +SKIP
        >>> model.train(gradient_steps=100)  # doctest: +SKIP
    """
    from stable_baselines3.common.buffers import ReplayBuffer

    trajectories = selection.trajectories(task) if task in selection.parts else []
    size = sum(map(len, trajectories))
    if not size:
        raise SelectionError(
            f"{selection.dataset.folder}: the selection holds no transition of task {task}; it has the tasks "
            f"{sorted(selection.parts)}"
        )
    environment = selection.dataset.environment
    buffer = ReplayBuffer(
        size,
        Box(-np.inf, np.inf, (environment.observation_dim,), np.float32),
        Box(-1.0, 1.0, (environment.action_dim,), np.float32),
        device=device,
    )
    row = 0
    for trajectory in trajectories:
        rows = slice(row, row := row + len(trajectory))
        buffer.observations[rows, 0] = trajectory.observations[:-1]
        buffer.next_observations[rows, 0] = trajectory.observations[1:]
        buffer.actions[rows, 0] = trajectory.actions
        buffer.rewards[rows, 0] = trajectory.rewards
        buffer.dones[rows, 0] = trajectory.terminated | trajectory.truncated
        buffer.timeouts[rows, 0] = trajectory.truncated & ~trajectory.terminated
    buffer.full = True
    return buffer
