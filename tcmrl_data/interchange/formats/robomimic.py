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
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.interchange.formats.base import Format
from tcmrl_data.interchange.formats.describing import stored_episodes, task_attributes
from tcmrl_data.interchange.formats.new_folder import require_room_for
from tcmrl_data.store.keys import PartKey

if TYPE_CHECKING:
    import h5py

LAYOUT, FORMAT_VERSION = "tcmrl-robomimic", 1
OBSERVATION_KEY = "flat"
STEP_ATTRIBUTE = "step"
GYM_TYPE = 2
"""robomimic's number for environments of Gym (`EnvType.GYM_TYPE`)."""


@final
class RobomimicFormat(Format):
    """One file per task; an episode without steps is a `StoreError`."""

    name = "robomimic"

    def place(self, selection: Selection, task: Task) -> str:
        return f"task_{task.index:05d}.hdf5"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        import h5py

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


def _write_demonstration(group: "h5py.Group", trajectory: Trajectory, step: int) -> None:
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
