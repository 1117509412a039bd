"""HDF5 in the layout of robomimic, one file per task, `task_00000.hdf5` and so on.

```
/data                              attributes `total` (steps) and `env_args` (JSON)
/data/demo_0                       attributes `num_samples`, and `step`: of its snapshot
/data/demo_0/obs/flat              (T, observation_dim) float32; `next_obs/flat` likewise
/data/demo_0/{actions, rewards, dones}
/data/demo_0/{terminated, truncated, success …}   what robomimic does not read
/mask/train                        names of all demonstrations: the task's split
/mask/step_5000                    names of the demonstrations of a snapshot
```

`dones` is 1 where the task ended an episode, not at a time limit, so that values are bootstrapped there.
`flat` is the name that robomimic's conversion of D4RL gives to state vectors. The layout:
https://robomimic.github.io/docs/datasets/overview.html

Files of other programs are one task each. Their `dones` are taken as terminations, as robomimic's own
algorithms do; one before the last step of a demonstration is left out.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import final

import h5py
import numpy as np

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import Format, episode_arrays
from tcmrl_data.interchange.hdf5_file import Hdf5File, new_file, write_array
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    FileTask,
    ReadPart,
    episodes_of_rows,
    parts_of_task,
    stored_episode,
)
from tcmrl_data.store.tables import PartKey

OBSERVATION_KEY = "flat"
STEP_ATTRIBUTE = "step"
GYM_TYPE = 2
"""robomimic's number for environments of Gym (`EnvType.GYM_TYPE`)."""


@final
class RobomimicFormat(Format):
    """One file per task; an episode without steps is a `StoreError`."""

    name = "robomimic"
    suffix = ".hdf5"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        settings = selection.dataset.manifest.recipe.environment.model_dump(mode="json")
        environment = {  # robomimic can make none of ours
            "env_name": selection.dataset.name,
            "type": GYM_TYPE,
            "env_kwargs": {"settings": settings, "parameters": dict(task.parameters)},
        }
        names: dict[int, list[bytes]] = {}
        with new_file(path, "x") as file:
            file.attrs.update(self.attributes(selection, task))
            data = file.create_group("data")
            data.attrs["env_args"] = json.dumps(environment)
            total = 0
            for key, trajectories in self.parts(selection, task, path):
                for index, trajectory in enumerate(trajectories, start=len(data)):
                    _write_demonstration(data.create_group(f"demo_{index}"), trajectory, key.step)
                    names.setdefault(key.step, []).append(f"demo_{index}".encode())
                    total += len(trajectory)
                file.flush()  # what the file keeps in memory is counted as room otherwise
                yield key
            data.attrs["total"] = total
            mask = file.create_group("mask")
            mask[task.split] = np.array([name for members in names.values() for name in members])
            for step, members in names.items():
                mask[f"step_{step}"] = np.array(members)


def _write_demonstration(group: h5py.Group, trajectory: Trajectory, step: int) -> None:
    group.attrs["num_samples"] = len(trajectory)
    group.attrs[STEP_ATTRIBUTE] = step
    arrays = episode_arrays(trajectory)
    observations = arrays.pop("observations")
    arrays["dones"] = trajectory.terminated.astype(np.int64)
    arrays[f"obs/{OBSERVATION_KEY}"] = observations[:-1]
    arrays[f"next_obs/{OBSERVATION_KEY}"] = observations[1:]
    for name, array in arrays.items():
        write_array(group, name, array)


def read_robomimic(file: Hdf5File, keys: tuple[str, ...] | None, cuts: EpisodeCuts) -> Iterator[ReadPart]:
    """The parts of a file; all observations of rank 2 side by side where `keys` names none."""
    groups = [f"/data/{name}" for name in file.numbered("/data", "demo_")]
    if not groups:
        raise StoreError(f"{file.path}: /data holds no demo_0")
    first = f"{groups[0]}/obs"
    keys = keys or tuple(name for name in file.members(first) if file.rank(f"{first}/{name}") == 2)
    if not keys:
        raise StoreError(f"{file.path}: {first} holds no observations of rank 2")
    is_ours = file.attribute("/", "format") == f"tcmrl-{RobomimicFormat.name}"
    read = _our_demonstration if is_ours else _demonstration
    episodes = (
        (file.step(group, STEP_ATTRIBUTE) if is_ours else 0, trajectory)
        for group in groups
        for trajectory in read(file, group, keys, cuts)
    )
    return parts_of_task(episodes, file.task() if is_ours else FileTask(), place=str(file.path))


def _demonstration(file: Hdf5File, group: str, keys: tuple[str, ...], cuts: EpisodeCuts) -> list[Trajectory]:
    names = file.members(group)
    # `terminated` and `truncated` are not robomimic's own, but say what `dones` leaves open
    ended = file.array(f"{group}/{'terminated' if 'terminated' in names else 'dones'}").reshape(-1) != 0
    ended[:-1] = False
    rows = {
        "observations": file.columns(f"{group}/obs", keys),
        "actions": file.array(f"{group}/actions"),
        "rewards": file.array(f"{group}/rewards"),
        "terminals": ended,
        "timeouts": file.array(f"{group}/truncated") if "truncated" in names else None,
        "next_observations": file.columns(f"{group}/next_obs", keys) if "next_obs" in names else None,
    }
    return episodes_of_rows(rows, cuts=cuts, place=f"{file.path}: {group}")


def _our_demonstration(
    file: Hdf5File, group: str, keys: tuple[str, ...], cuts: EpisodeCuts
) -> list[Trajectory]:
    names = [name for name in file.members(group) if file.rank(f"{group}/{name}")]
    arrays = {name: file.array(f"{group}/{name}") for name in names if name != "dones"}
    arrays["observations"] = file.columns(f"{group}/obs", keys)
    arrays["next_observations"] = file.columns(f"{group}/next_obs", keys)
    return [stored_episode(arrays, cuts=cuts, place=f"{file.path}: {group}")]
