"""NumPy archives, `task_00000.npz` and so on, which `numpy.load` opens without pickle.

| array | shape | holds |
|---|---|---|
| observations, next_observations | (N, observation_dim) float32 | all episodes behind one another |
| actions | (N, action_dim) float32 | as executed, in [-1, 1] |
| rewards | (N,) float32 | |
| terminated, truncated | (N,) bool | the task's end, and the time limit |
| episode | (N,) int64 | number of the episode, from 0 |
| snapshot | (N,) int64 | training step of the policy that acted |
| task | () text | the task as JSON: index, split, parameters |
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.interchange.exporting import Format
from tcmrl_data.store.keys import PartKey


@final
class NpzFormat(Format):
    """One archive per task; a whole task is in memory at a time."""

    name = "npz"

    def place(self, selection: Selection, task: Task) -> str:
        return f"task_{task.index:05d}.npz"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        np.savez_compressed(path, allow_pickle=False, **_arrays(selection, task))
        yield from selection.parts[task.index]


def _arrays(selection: Selection, task: Task) -> dict[str, npt.NDArray[Any]]:
    parts = [(key.step, selection.dataset.trajectories(*key)) for key in selection.parts[task.index]]
    episodes = [(step, episode) for step, part in parts for episode in part]
    lengths = [len(episode) for _, episode in episodes]
    columns = {name: [getattr(episode, name) for _, episode in episodes] for name in _NAMES}
    columns["observations"] = [episode.observations[:-1] for _, episode in episodes]
    columns["next_observations"] = [episode.observations[1:] for _, episode in episodes]
    described = {"index": task.index, "split": task.split, "parameters": dict(task.parameters)}
    return {
        **{name: np.concatenate(values) for name, values in columns.items()},
        "episode": np.repeat(np.arange(len(episodes)), lengths),
        "snapshot": np.repeat([step for step, _ in episodes], lengths),
        "task": np.array(json.dumps(described)),
    }


_NAMES = ("actions", "rewards", "terminated", "truncated")
