"""Samplers over a test's own episodes, packed like the parts of a dataset."""

from collections.abc import Sequence

import numpy as np

from tcmrl_data import BatchRequest, Trajectory
from tcmrl_data.envs.base import DENSE_REWARDS
from tcmrl_data.sampling.rows import Episodes, PackedRows, fill_rows
from tcmrl_data.sampling.sampler import Sampler
from tcmrl_data.store.arrays import pack


def rows_of(tasks: Sequence[Sequence[Trajectory]]) -> PackedRows:
    """The packed rows of some tasks' episodes, a part per task."""
    first = tasks[0][0]
    observation_dim, action_dim = first.observations.shape[1], first.actions.shape[1]
    counts = [sum(len(episode) + 1 for episode in task) for task in tasks]
    width = observation_dim + action_dim + 2 + (DENSE_REWARDS in first.extras)
    table = np.zeros((sum(counts) + max(counts), width), dtype=np.float32)
    lengths, start = [], 0
    for task, count in zip(tasks, counts, strict=True):
        lengths.append(fill_rows(table[start : start + count], pack(task)))
        start += count
    owners = np.repeat(np.arange(len(tasks)), [len(task) for task in tasks])
    episodes = Episodes.of(np.concatenate(lengths), owners)
    return PackedRows(table, episodes, observation_dim, action_dim, np.arange(len(tasks)))


def sampler_of(
    tasks: Sequence[Sequence[Trajectory]], request: BatchRequest, *, seed: int = 0, stream: int = 0
) -> Sampler:
    """A sampler over some tasks' episodes."""
    return Sampler(rows_of(tasks), request, seed=seed, stream=stream, environment="memory", place="memory")


def numbered(task: int, episode: int, steps: int) -> Trajectory:
    """An episode whose observations state their origin: (task, episode, t)."""
    observations = np.array([[task, episode, t] for t in range(steps + 1)], dtype=np.float32)
    truncated = np.arange(1, steps + 1) == steps
    terminated = truncated & (episode % 2 == 0)
    rewards = observations[:-1] @ np.array([100.0, 10.0, 1.0])
    return Trajectory(observations, np.zeros((steps, 1)), rewards, terminated, truncated & ~terminated)


def numbered_tasks(lengths: Sequence[Sequence[int]]) -> list[list[Trajectory]]:
    """Numbered episodes of the given lengths, per task."""
    return [
        [numbered(task, episode, steps) for episode, steps in enumerate(task_lengths)]
        for task, task_lengths in enumerate(lengths)
    ]
