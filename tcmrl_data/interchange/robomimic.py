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
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, final

import h5py
import numpy as np

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import Format, require_room_for, stored_episodes, task_attributes
from tcmrl_data.interchange.hdf5_file import Hdf5File
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    FileTask,
    ReadPart,
    episode_of,
    episodes_of_rows,
    extras_of,
    joined_observations,
    last_flags,
    parts_of_task,
)
from tcmrl_data.store.keys import PartKey

LAYOUT, FORMAT_VERSION = "tcmrl-robomimic", 1
OBSERVATION_KEY = "flat"
STEP_ATTRIBUTE = "step"
GYM_TYPE = 2
"""robomimic's number for environments of Gym (`EnvType.GYM_TYPE`)."""

OUR_ARRAYS = ("actions", "rewards", "dones", "terminated", "truncated")
FLAGS = ("terminated", "truncated", "dones")
"""The first two are not robomimic's own, but say what `dones` leaves open."""

_DEMO = re.compile(r"demo_([0-9]{1,9})")


@final
class RobomimicFormat(Format):
    """One file per task; an episode without steps is a `StoreError`."""

    name = "robomimic"

    def place(self, selection: Selection, task: Task) -> str:
        return f"task_{task.index:05d}.hdf5"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        require_room_for(path)
        names: dict[int, list[bytes]] = {}
        with h5py.File(path, "x") as file:
            file.attrs.update(task_attributes(selection, task, layout=LAYOUT, version=FORMAT_VERSION))
            data = file.create_group("data")
            data.attrs["env_args"] = json.dumps(_environment(selection, task))
            total = first = 0
            for key in selection.parts[task.index]:
                trajectories = stored_episodes(selection.dataset, key, format_name=self.name)
                require_room_for(path, trajectories)
                for number, trajectory in enumerate(trajectories, start=first):
                    _write_demonstration(data.create_group(f"demo_{number}"), trajectory, key.step)
                    names.setdefault(key.step, []).append(f"demo_{number}".encode())
                    total += len(trajectory)
                first += len(trajectories)
                file.flush()  # what the file keeps in memory is counted as room otherwise
                yield key
            data.attrs["total"] = total
            mask = file.create_group("mask")
            mask[task.split] = np.array([name for members in names.values() for name in members])
            for step, members in names.items():
                mask[f"step_{step}"] = np.array(members)


def _environment(selection: Selection, task: Task) -> Mapping[str, Any]:
    """What robomimic would make the environment from; it can make none of ours."""
    settings = selection.dataset.manifest.recipe.environment.model_dump(mode="json")
    return {
        "env_name": selection.dataset.name,
        "type": GYM_TYPE,
        "env_kwargs": {"settings": settings, "parameters": dict(task.parameters)},
    }


def _write_demonstration(group: h5py.Group, trajectory: Trajectory, step: int) -> None:
    group.attrs["num_samples"] = len(trajectory)
    group.attrs[STEP_ATTRIBUTE] = step
    arrays = {
        "actions": trajectory.actions,
        "rewards": trajectory.rewards,
        "dones": trajectory.terminated.astype(np.int64),
        "terminated": trajectory.terminated,
        "truncated": trajectory.truncated,
        f"obs/{OBSERVATION_KEY}": trajectory.observations[:-1],
        f"next_obs/{OBSERVATION_KEY}": trajectory.observations[1:],
        **trajectory.extras,
    }
    for name, array in arrays.items():
        group.create_dataset(name, data=array)


def read_robomimic(file: Hdf5File, keys: tuple[str, ...] | None, cuts: EpisodeCuts) -> Iterator[ReadPart]:
    """The parts of a file; all observations of rank 2 side by side where `keys` names none."""
    names = [name for name in file.members("/data") if _DEMO.fullmatch(name)]
    names.sort(key=lambda name: int(name.removeprefix("demo_")))
    if not names:
        raise StoreError(f"{file.path}: /data holds no demo_0")
    keys = keys or _low_dimensional(file, f"/data/{names[0]}/obs")
    is_ours = file.attribute("/", "format") == LAYOUT
    task, about = file.task(version=FORMAT_VERSION) if is_ours else (None, FileTask())
    read = _our_demonstration if is_ours else _demonstration
    episodes = (
        (file.index(f"/data/{name}", STEP_ATTRIBUTE) if is_ours else 0, trajectory)
        for name in names
        for trajectory in read(file, f"/data/{name}", keys, cuts)
    )
    return parts_of_task(episodes, task, about, place=str(file.path))


def _low_dimensional(file: Hdf5File, group: str) -> tuple[str, ...]:
    keys = tuple(name for name in file.members(group) if file.rank(f"{group}/{name}") == 2)
    if not keys:
        raise StoreError(f"{file.path}: {group} holds no observations of rank 2")
    return keys


def _demonstration(file: Hdf5File, group: str, keys: tuple[str, ...], cuts: EpisodeCuts) -> list[Trajectory]:
    flags = {name: file.array(f"{group}/{name}") for name in FLAGS if file.holds(f"{group}/{name}")}
    terminals = flags.get("terminated", flags.get("dones"))
    if terminals is None:
        raise StoreError(f"{file.path}: {group}/dones is missing")
    terminals = terminals.reshape(-1) != 0
    terminals[:-1] = False
    has_next = file.is_group(f"{group}/next_obs")
    return episodes_of_rows(
        observations=file.columns(f"{group}/obs", keys),
        actions=file.array(f"{group}/actions"),
        rewards=file.array(f"{group}/rewards"),
        terminals=terminals,
        timeouts=flags.get("truncated"),
        next_observations=file.columns(f"{group}/next_obs", keys) if has_next else None,
        cuts=cuts,
        place=f"{file.path}: {group}",
    )


def _our_demonstration(
    file: Hdf5File, group: str, keys: tuple[str, ...], cuts: EpisodeCuts
) -> list[Trajectory]:
    """A demonstration that `RobomimicFormat` wrote, with its flags and further arrays."""
    place = f"{file.path}: {group}"
    arrays = {
        name: file.array(f"{group}/{name}") for name in file.members(group) if file.rank(f"{group}/{name}")
    }
    missing = [name for name in OUR_ARRAYS if name not in arrays]
    if missing:
        raise StoreError(f"{place}/{missing[0]} is missing")
    actions, rewards, _, terminated, truncated = (arrays.pop(name) for name in OUR_ARRAYS)
    both = (file.columns(f"{group}/{name}", keys) for name in ("obs", "next_obs"))
    made = episode_of(
        joined_observations(*both, place=place),
        actions,
        rewards,
        ended=last_flags(terminated, truncated, place),
        extras=extras_of(arrays),
        cuts=cuts,
        place=place,
    )
    return [made]
