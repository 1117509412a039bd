"""Draws the same batches with other libraries, used as their documentation recommends, from the same data.

Every function takes the data and returns the peer's draws by kind of batch. A draw delivers what ours
does: float32 tensors of observations, actions, rewards, next observations and termination, the same number of
steps. A peer that does not know tasks draws from all of them at once, which is less work than ours.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

import tcmrl_data
from tcmrl_data.interchange.minari import dataset_id
from tcmrl_data.interchange.sb3 import to_sb3_buffer

Draw = Callable[[], object]
Draws = Mapping[str, Draw]
FIELDS = ("observations", "actions", "rewards", "next_observations", "terminated")


@dataclass(frozen=True)
class Work:
    """Batch sizes: tasks × transitions, tasks × one trajectory, and the number of windows of a length."""

    tasks: int
    transitions: int
    windows: int
    window_length: int
    horizon: int

    @property
    def steps(self) -> dict[str, int]:
        """Steps in a batch of every kind; a full step takes all windows of the context trajectories."""
        transitions, trajectories = self.tasks * self.transitions, self.tasks * self.horizon
        return {
            "transitions": transitions,
            "trajectories": trajectories,
            "windows": self.windows * self.window_length,
            "full_step": transitions + 2 * trajectories + self.full_windows * self.window_length,
        }

    @property
    def full_windows(self) -> int:
        """Windows of a full step."""
        return self.tasks * (self.horizon - self.window_length + 1)


@dataclass(frozen=True)
class Data:
    """A dataset whose episodes all have the horizon's length; `arrays` holds its transitions in order."""

    selection: tcmrl_data.Selection
    arrays: Mapping[str, npt.NDArray[np.float32]]
    horizon: int

    def __len__(self) -> int:
        return len(self.arrays["rewards"])


def flat_data(selection: tcmrl_data.Selection) -> Data:
    """All transitions of a selection as flat arrays."""
    episodes = [episode for task in selection.tasks for episode in selection.trajectories(task.index)]
    horizon = len(episodes[0])
    columns = {
        name: [getattr(episode, name) for episode in episodes]
        for name in ("actions", "rewards", "terminated")
    }
    columns["observations"] = [episode.observations[:-1] for episode in episodes]
    columns["next_observations"] = [episode.observations[1:] for episode in episodes]
    arrays = {name: np.concatenate(columns[name]).astype(np.float32) for name in FIELDS}
    return Data(selection, arrays, horizon)


def sequence_loop(data: Data, work: Work) -> Draws:
    """One slice per field and sequence, made a tensor, then stacked: a map-style dataset under a loader.

    The scheme of diffusion_policy's SequenceSampler with PyTorch's default collation, without its workers.
    """
    random = np.random.default_rng(0)
    episodes = len(data) // data.horizon

    def draw(count: int, length: int) -> dict[str, torch.Tensor]:
        starts = random.integers(episodes, size=count) * data.horizon
        starts += random.integers(data.horizon - length + 1, size=count)
        items = [
            {name: torch.from_numpy(data.arrays[name][start : start + length]) for name in FIELDS}
            for start in starts
        ]
        return {name: torch.stack([item[name] for item in items]) for name in FIELDS}

    return _draws(draw, work)


def torchrl_samplers(data: Data, work: Work) -> Draws:
    """RandomSampler for transitions, SliceSampler for the rest, over one LazyTensorStorage of all tasks.

    The slice samplers receive the ends of episodes and cache the indices that they compute from them.
    """
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, SliceSampler

    tensors = {name: torch.from_numpy(data.arrays[name]) for name in FIELDS}
    content = {
        "observation": tensors["observations"],
        "action": tensors["actions"],
        "next": {
            "observation": tensors["next_observations"],
            "reward": tensors["rewards"][:, None],
            "terminated": tensors["terminated"][:, None],
        },
    }
    storage = LazyTensorStorage(len(data))
    random = ReplayBuffer(storage=storage, sampler=RandomSampler())
    random.extend(TensorDict(content, batch_size=[len(data)]))
    ends = torch.arange(1, len(data) + 1) % data.horizon == 0
    slices: dict[int, ReplayBuffer] = {}

    def draw(count: int, length: int) -> object:
        if length == 1:
            return random.sample(count)
        if length not in slices:
            sampler = SliceSampler(
                slice_len=length, ends=ends, cache_values=True, truncated_key=None, init_key=None
            )
            slices[length] = ReplayBuffer(storage=storage, sampler=sampler)
        return slices[length].sample(count * length)

    return _draws(draw, work)


def sb3_buffers(data: Data, work: Work) -> Draws:
    """A Stable-Baselines3 ReplayBuffer per task, sampled one after the other and stacked."""
    buffers = [to_sb3_buffer(data.selection, task.index) for task in data.selection.tasks]
    random = np.random.default_rng(0)

    def transitions() -> object:
        chosen = random.permutation(len(buffers))[: work.tasks]
        samples = [buffers[task].sample(work.transitions) for task in chosen]
        return [torch.stack(tensors) for tensors in list(zip(*samples, strict=True))[:5]]

    return {"transitions": transitions}


def minari_datasets(data: Data, work: Work, root: Path) -> dict[str, Draws]:
    """`sample_episodes` of one Minari dataset per task, from disk; and the same from episodes in memory."""
    import minari

    if not root.exists():
        tcmrl_data.export_dataset(data.selection.dataset, "minari", root)
    os.environ["MINARI_DATASETS_PATH"] = str(root.resolve())
    tasks = [task.index for task in data.selection.tasks]
    opened = [minari.load_dataset(dataset_id(data.selection.dataset, task)) for task in tasks]
    preloaded = [list(dataset.iterate_episodes()) for dataset in opened]
    random = np.random.default_rng(0)

    def stacked(episodes: list[minari.EpisodeData]) -> list[torch.Tensor]:
        fields = [
            [episode.observations[:-1] for episode in episodes],
            [episode.actions for episode in episodes],
            [episode.rewards for episode in episodes],
            [episode.observations[1:] for episode in episodes],
            [episode.terminations for episode in episodes],
        ]
        return [torch.from_numpy(np.stack(arrays).astype(np.float32, copy=False)) for arrays in fields]

    def from_disk() -> object:
        chosen = random.permutation(len(opened))[: work.tasks]
        return stacked([opened[task].sample_episodes(1)[0] for task in chosen])

    def from_memory() -> object:
        chosen = random.permutation(len(opened))[: work.tasks]
        return stacked([preloaded[task][random.integers(len(preloaded[task]))] for task in chosen])

    return {"minari_disk": {"trajectories": from_disk}, "minari_preloaded": {"trajectories": from_memory}}


def _draws(draw: Callable[[int, int], object], work: Work) -> Draws:
    """All kinds from one function of (number of sequences, their length)."""

    def full_step() -> object:
        return (
            draw(work.tasks * work.transitions, 1),
            draw(work.tasks, work.horizon),
            draw(work.tasks, work.horizon),
            draw(work.full_windows, work.window_length),
        )

    return {
        "transitions": lambda: draw(work.tasks * work.transitions, 1),
        "trajectories": lambda: draw(work.tasks, work.horizon),
        "windows": lambda: draw(work.windows, work.window_length),
        "full_step": full_step,
    }
