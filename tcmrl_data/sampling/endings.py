"""Returns to go, discounts and final observations of steps."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from tcmrl_data.envs.base import Reward
from tcmrl_data.sampling.batch import Steps
from tcmrl_data.sampling.rows import Episodes, Indices, PackedRows, Table

CHUNK_ROWS = 2**16


@dataclass(frozen=True)
class Endings:
    """Returns to go of packed rows; the other values are computed from the positions of episodes.

    Attributes:
        rows: the packed selection.
        returns_to_go: (rows,) discounted sum of rewards from a step to the end of its episode; 0 for rows
            that are not steps.
        discounts: (longest episode + 1,) powers of gamma, from gamma^0.
    """

    rows: PackedRows
    returns_to_go: Table
    discounts: Table

    @classmethod
    def of(cls, rows: PackedRows, gamma: float, rewards: Reward = "stored") -> "Endings":
        """Computes the endings for a discount factor, in double precision and chunks of whole episodes."""
        column = rows.reward_column(rewards)
        episodes, returns = rows.episodes, np.zeros(len(rows.table), dtype=np.float32)
        ends = episodes.starts + episodes.lengths
        first = 0
        while first < len(ends):
            last = max(first + 1, int(np.searchsorted(ends, episodes.starts[first] + CHUNK_ROWS)))
            chunk = slice(int(episodes.starts[first]), int(ends[last - 1]) + 1)
            within = Episodes(
                episodes.starts[first:last] - chunk.start, episodes.lengths[first:last], episodes.task_ranges
            )
            returns[chunk] = _returns_to_go(rows.table[chunk, column].astype(np.float64), within, gamma)
            first = last
        discounts = gamma ** np.arange(episodes.longest + 1, dtype=np.float64)
        return cls(rows, returns, discounts.astype(np.float32))

    def attach(self, steps: Steps, first_rows: Indices) -> Steps:
        """The steps with their returns to go and other endings; endings are zero on padding.

        Args:
            steps: transitions (tasks, number), or windows or trajectories (tasks, number, length).
            first_rows: (tasks, number) first rows of the transitions, windows or trajectories.
        """
        rows, shape = self.rows, steps.rewards.shape
        length = 1 if len(shape) == 2 else shape[-1]
        episodes = np.searchsorted(rows.episodes.starts, first_rows, side="right") - 1
        starts, lengths = rows.episodes.starts[episodes], rows.episodes.lengths[episodes]
        times = (first_rows - starts)[..., None] + np.arange(length)
        is_step = times < lengths[..., None]
        times = np.where(is_step, times, 0)
        returns = np.where(is_step, self.returns_to_go[starts[..., None] + times], 0)
        ended = rows.table[starts + lengths - 1, rows.terminated_column] > 0
        weighs = is_step & ~ended[..., None]
        discounts = np.where(weighs, self.discounts[lengths[..., None] - times], 0)
        final = rows.table[starts + lengths, : rows.observation_dim][..., None, :] * is_step[..., None]
        vectors = (*shape, rows.observation_dim)
        device = steps.rewards.device
        return replace(
            steps,
            returns_to_go=torch.from_numpy(returns.reshape(shape)).to(device),
            discounts_to_end=torch.from_numpy(discounts.reshape(shape)).to(device),
            final_observations=torch.from_numpy(final.reshape(vectors)).to(device),
            times=torch.from_numpy(times.reshape(shape)).to(device),
        )


def _returns_to_go(
    rewards: np.typing.NDArray[np.float64], episodes: Episodes, gamma: float
) -> np.typing.NDArray[np.float64]:
    """G_t = r_t + gamma G_{t+1} with G_T = 0, (rows,); computed backwards in t for all episodes together."""
    result = np.zeros(len(rewards))
    returns = np.zeros(len(episodes.starts))
    for t in range(episodes.longest - 1, -1, -1):
        active = np.flatnonzero(episodes.lengths > t)
        rows = episodes.starts[active] + t
        returns[active] = rewards[rows] + gamma * returns[active]
        result[rows] = returns[active]
    return result
