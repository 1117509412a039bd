"""Meta-training batches: index arithmetic over packed rows, no data touched but by one gather per kind."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from tcmrl_data.errors import SelectionError
from tcmrl_data.seeding import NO_TASK, Purpose, keyed_sequence
from tcmrl_data.trajectory import Trajectory

if TYPE_CHECKING:
    from tcmrl_data.dataset import Selection

Indices = npt.NDArray[np.int64]


class BatchSizes(BaseModel):
    """What one batch holds.

    Attributes:
        tasks: tasks per batch, drawn without replacement (capped at the selected tasks).
        transitions: transitions per task for the actor-critic.
        context_trajectories: context trajectories per task; one of these numbers is drawn per batch.
        execution_trajectories: execution trajectories per task, never among the context ones.
        windows: K-step windows per task, uniform over all valid windows; 0 for none.
        window_length: K.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tasks: int = Field(default=16, ge=2)
    transitions: int = Field(default=256, ge=1)
    context_trajectories: tuple[int, ...] = Field(default=(1,), min_length=1)
    execution_trajectories: int = Field(default=1, ge=0)
    windows: int = Field(default=0, ge=0)
    window_length: int = Field(default=2, ge=2)


@dataclass(frozen=True)
class Steps:
    """Transitions with any leading shape.

    Attributes:
        observations: (..., observation_dim).
        actions: (..., action_dim) in [-1, 1].
        rewards: (...,).
        next_observations: (..., observation_dim).
        terminated: (...,) float, 1 where the task ended the episode; a time limit is 0.
        mask: (...,) bool, False on padding.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Batch:
    """The n-th batch of a stream, float32.

    Attributes:
        task_indices: (tasks,) int64, distinct.
        transitions: leading shape (tasks, transitions).
        context: leading shape (tasks, context trajectories, longest episode), padded at the end.
        execution: leading shape (tasks, execution trajectories, longest episode), padded at the end.
        windows: leading shape (tasks, windows, K), each inside one episode.
    """

    task_indices: Tensor
    transitions: Steps
    context: Steps
    execution: Steps
    windows: Steps


@dataclass(frozen=True)
class Moments:
    """Statistics of the selected transitions, float64; standard deviations are at least 1e-6.

    Attributes:
        observation_mean, observation_std: (observation_dim,).
        delta_mean, delta_std: (observation_dim,), of next observation minus observation.
        action_mean, action_std: (action_dim,).
        reward_mean, reward_std, reward_min, reward_max: per step.
        longest_episode: steps.
    """

    observation_mean: npt.NDArray[np.float64]
    observation_std: npt.NDArray[np.float64]
    delta_mean: npt.NDArray[np.float64]
    delta_std: npt.NDArray[np.float64]
    action_mean: npt.NDArray[np.float64]
    action_std: npt.NDArray[np.float64]
    reward_mean: float
    reward_std: float
    reward_min: float
    reward_max: float
    longest_episode: int


class Sampler:
    """Serves batch n as a pure function of (seed, n); made by `Selection.sampler`.

    All selected steps lie in one float32 table, a row per observation: (observation, action, reward,
    terminated). An episode of T steps takes T + 1 rows, so the next observation is the next row; the
    last row of an episode is never drawn as a transition.

    Within a batch, tasks are drawn without replacement; within a task, transitions and windows uniformly
    over all valid ones (with replacement), trajectories uniformly without replacement, so that context
    and execution trajectories differ. Task parameters are never loaded.
    """

    def __init__(self, selection: "Selection", sizes: BatchSizes, *, seed: int, device: str = "cpu") -> None:
        self.sizes, self.device = sizes, torch.device(device)
        environment = selection.dataset.environment
        self.observation_dim, self.action_dim = environment.observation_dim, environment.action_dim
        self.task_indices = np.array([task.index for task in selection.tasks], dtype=np.int64)
        self.num_tasks = min(sizes.tasks, len(self.task_indices))
        sequence = keyed_sequence(seed, environment.name, NO_TASK, Purpose.SAMPLER)
        self._key = sequence.generate_state(2, np.uint64)
        self._load(selection)
        self._check(selection)

    def _load(self, selection: "Selection") -> None:
        """Fills the row table, the episode table, and per task the ranges of episodes and transitions."""
        episodes = [selection.trajectories(task.index) for task in selection.tasks]
        flat = [trajectory for task in episodes for trajectory in task]
        self._lengths = np.array([len(each) for each in flat], dtype=np.int64)
        ends = np.cumsum(self._lengths + 1)
        self._starts = ends - self._lengths - 1
        self._episode_ranges = _ranges([len(task) for task in episodes])
        self._rows = torch.from_numpy(_table(flat, self.observation_dim, self.action_dim)).to(self.device)
        self._longest = int(self._lengths.max())
        self._transitions, self._transition_ranges = self._valid_rows(1)
        self._windows, self._window_ranges = self._valid_rows(self.sizes.window_length)

    def _valid_rows(self, steps: int) -> tuple[Indices, Indices]:
        """Rows from which `steps` steps stay inside an episode, and each task's range among them."""
        counts = np.maximum(self._lengths - steps + 1, 0)
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        per_task = [int(counts[first:last].sum()) for first, last in self._episode_ranges]
        return np.repeat(self._starts, counts) + within, _ranges(per_task)

    def _check(self, selection: "Selection") -> None:
        episodes = np.diff(self._episode_ranges)[:, 0]
        needed = max(self.sizes.context_trajectories) + self.sizes.execution_trajectories
        for task, count, windows in zip(
            self.task_indices, episodes, np.diff(self._window_ranges)[:, 0], strict=True
        ):
            place = f"{selection.dataset.folder}: task {task}"
            if count < needed:
                raise SelectionError(f"{place} has {count} selected trajectories, a batch takes {needed}")
            if self.sizes.windows and not windows:
                raise SelectionError(
                    f"{place} has no trajectory of {self.sizes.window_length} steps for a window"
                )

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0; the same for the same selection, sizes and seed."""
        random = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, 0, n]))
        tasks = random.permutation(len(self.task_indices))[: self.num_tasks]
        sizes = self.sizes
        num_context = int(random.choice(sizes.context_trajectories))
        transitions = self._draw(random, self._transitions, self._transition_ranges[tasks], sizes.transitions)
        windows = self._draw(random, self._windows, self._window_ranges[tasks], sizes.windows)
        episodes = distinct(random, self._episode_ranges[tasks], num_context + sizes.execution_trajectories)
        return Batch(
            task_indices=torch.from_numpy(self.task_indices[tasks]),
            transitions=self._gather(transitions, np.ones_like(transitions, dtype=bool)),
            context=self._trajectories(episodes[:, :num_context]),
            execution=self._trajectories(episodes[:, num_context:]),
            windows=self._window_steps(windows),
        )

    def moments(self) -> Moments:
        """Statistics over all selected transitions."""
        steps = self._gather(self._transitions, np.ones(len(self._transitions), dtype=bool))

        def mean_and_std(values: Tensor) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
            array = values.cpu().numpy().astype(np.float64)
            return array.mean(axis=0), np.maximum(array.std(axis=0), 1e-6)

        reward_mean, reward_std = mean_and_std(steps.rewards)
        return Moments(
            *mean_and_std(steps.observations),
            *mean_and_std(steps.next_observations - steps.observations),
            *mean_and_std(steps.actions),
            float(reward_mean),
            float(reward_std),
            float(steps.rewards.min()),
            float(steps.rewards.max()),
            self._longest,
        )

    @staticmethod
    def _draw(random: np.random.Generator, rows: Indices, ranges: Indices, count: int) -> Indices:
        """(tasks, count) rows, uniform over each task's range."""
        if not count:
            return np.zeros((len(ranges), 0), dtype=np.int64)
        return rows[random.integers(ranges[:, :1], ranges[:, 1:], (len(ranges), count))]

    def _trajectories(self, episodes: Indices) -> Steps:
        """Whole episodes, (tasks, count) → (tasks, count, longest episode), padded with the last step."""
        t = np.arange(self._longest)
        lengths = self._lengths[episodes][..., None]
        return self._gather(self._starts[episodes][..., None] + np.minimum(t, lengths - 1), t < lengths)

    def _window_steps(self, first_rows: Indices) -> Steps:
        rows = first_rows[..., None] + np.arange(self.sizes.window_length)
        return self._gather(rows, np.ones_like(rows, dtype=bool))

    def _gather(self, rows: Indices, mask: npt.NDArray[np.bool_]) -> Steps:
        observation_dim, action_dim = self.observation_dim, self.action_dim
        index = torch.from_numpy(rows.reshape(-1)).to(self.device)
        values = torch.index_select(self._rows, 0, index).view(*rows.shape, self._rows.shape[1])
        following = torch.index_select(self._rows[:, :observation_dim], 0, index + 1)
        return Steps(
            observations=values[..., :observation_dim],
            actions=values[..., observation_dim : observation_dim + action_dim],
            rewards=values[..., -2],
            next_observations=following.view(*rows.shape, observation_dim),
            terminated=values[..., -1],
            mask=torch.from_numpy(mask).to(self.device),
        )


def distinct(random: np.random.Generator, ranges: Indices, count: int) -> Indices:
    """(tasks, count) integers, uniform without replacement within each row's [first, last)."""
    sizes = ranges[:, 1] - ranges[:, 0]
    picks = np.zeros((len(ranges), count), dtype=np.int64)
    for j in range(count):
        pick = random.integers(0, sizes - j)
        for earlier in np.sort(picks[:, :j], axis=1).T:
            pick += pick >= earlier  # step over what is taken, smallest first
        picks[:, j] = pick
    return picks + ranges[:, :1]


def _ranges(counts: list[int]) -> Indices:
    ends = np.cumsum(counts, dtype=np.int64)
    return np.stack([ends - counts, ends], axis=1)


def _table(trajectories: list[Trajectory], observation_dim: int, action_dim: int) -> npt.NDArray[np.float32]:
    """Rows (observation, action, reward, terminated); an episode's last row holds an observation alone."""
    rows = sum(len(each) + 1 for each in trajectories)
    table = np.zeros((rows, observation_dim + action_dim + 2), dtype=np.float32)
    start = 0
    for each in trajectories:
        stop = start + len(each)
        table[start : stop + 1, :observation_dim] = each.observations
        table[start:stop, observation_dim:-2] = each.actions
        table[start:stop, -2] = each.rewards
        table[start:stop, -1] = each.terminated
        start = stop + 1
    return table
