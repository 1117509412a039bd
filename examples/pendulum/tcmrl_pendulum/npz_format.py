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
from tcmrl_data.envs.base import Task
from tcmrl_data.interchange.exporting import Format, transitions
from tcmrl_data.store.tables import PartKey


@final
class NpzFormat(Format):
    """One archive per task; a whole task is in memory at a time."""

    name = "npz"
    suffix = ".npz"
    takes_empty_episodes = True

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        parts: list[dict[str, npt.NDArray[Any]]] = []
        episodes = 0
        for key, trajectories in self.parts(selection, task, path):
            parts.append(transitions(trajectories, first=episodes, step=key.step))
            episodes += len(trajectories)
            yield key
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        described = {"index": task.index, "split": task.split, "parameters": dict(task.parameters)}
        arrays["snapshot"] = arrays.pop("step")
        np.savez_compressed(path, allow_pickle=False, task=np.array(json.dumps(described)), **arrays)
