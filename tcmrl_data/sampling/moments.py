"""Statistics of packed rows, computed chunk by chunk to save memory."""

import numpy as np
import numpy.typing as npt

from tcmrl_data.sampling.batch import Moments
from tcmrl_data.sampling.rows import Episodes, PackedRows

CHUNK_ROWS = 2**16
SMALLEST_STD = 1e-6

Values = npt.NDArray[np.float64]


def moments_of(rows: PackedRows) -> Moments:
    """Statistics of all transitions of the rows, computed in double precision."""
    table, episodes = rows.table, rows.episodes
    stop = int(episodes.starts[-1] + episodes.lengths[-1])
    width, flags = rows.observation_dim, rows.terminated_column
    total = _Sums(2 * rows.observation_dim + rows.action_dim + 1 + rows.has_dense)
    for first in range(0, stop, CHUNK_ROWS):
        last = min(first + CHUNK_ROWS, stop)
        kept = _is_step(episodes, first, last)
        values = table[first:last][kept].astype(np.float64)
        following = table[first + 1 : last + 1, :width][kept]
        columns = (following - values[:, :width], values[:, :flags], values[:, flags + 1 :])
        total.add(np.concatenate(columns, axis=1))
    mean, std = total.mean, total.std
    delta, observation = slice(0, width), slice(width, 2 * width)
    action, reward = slice(2 * width, width + flags - 1), width + flags - 1
    dense = (float(total.least[-1]), float(total.most[-1])) if rows.has_dense else None
    return Moments(
        observation_mean=mean[observation],
        observation_std=std[observation],
        delta_mean=mean[delta],
        delta_std=std[delta],
        action_mean=mean[action],
        action_std=std[action],
        reward_mean=float(mean[reward]),
        reward_std=float(std[reward]),
        reward_min=float(total.least[reward]),
        reward_max=float(total.most[reward]),
        longest_episode=episodes.longest,
        dense_reward_range=dense,
    )


def _is_step(episodes: Episodes, first: int, last: int) -> npt.NDArray[np.bool_]:
    """Whether rows first to last - 1 are transitions, (last - first,); the others are last observations."""
    rows = np.arange(first, last)
    latest = np.searchsorted(episodes.starts, rows, side="right") - 1
    ends = episodes.starts[latest] + episodes.lengths[latest]
    result: npt.NDArray[np.bool_] = (latest >= 0) & (rows < ends)
    return result


class _Sums:
    """Mean, variance and range of columns, merged chunk by chunk (Chan, Golub and LeVeque, 1983)."""

    def __init__(self, columns: int) -> None:
        self.count, self.mean, self._squares = 0, np.zeros(columns), np.zeros(columns)
        self.least, self.most = np.full(columns, np.inf), np.full(columns, -np.inf)

    def add(self, values: Values) -> None:
        if not len(values):
            return
        count, mean = self.count + len(values), values.mean(axis=0)
        difference = mean - self.mean
        between = difference**2 * self.count * len(values) / count
        self._squares += np.square(values - mean).sum(axis=0) + between
        self.mean = self.mean + difference * len(values) / count
        self.least, self.most = (
            np.minimum(self.least, values.min(axis=0)),
            np.maximum(self.most, values.max(axis=0)),
        )
        self.count = count

    @property
    def std(self) -> Values:
        result: Values = np.maximum(np.sqrt(self._squares / self.count), SMALLEST_STD)
        return result
