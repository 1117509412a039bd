"""HDF5, one file per task: flat arrays in the manner of D4RL, and one group per episode.

```
/observations /actions /rewards /next_observations    (N, …) float32, all episodes behind one another
/terminals /timeouts                                  (N,) bool; a time limit is never a terminal
/episode /step                                        (N,) int64: number of the episode, its snapshot's step
/success …                                            (N,) further per-step arrays, where the dataset has them
/episodes/000000/{observations (T + 1, …), actions, rewards, terminated, truncated, …}
```

Attributes of the file name the environment, the task with its parameters and split, the seed, and the
dataset it came from.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.formats.base import Format
from tcmrl_data.interchange.formats.describing import task_attributes
from tcmrl_data.interchange.formats.new_folder import require_room_for
from tcmrl_data.store.keys import PartKey

if TYPE_CHECKING:
    import h5py

LAYOUT, FORMAT_VERSION = "tcmrl-hdf5", 1
EPISODE_ARRAYS = ("observations", "actions", "rewards", "terminated", "truncated")
CHUNK_ROWS = 4_096


@final
class Hdf5Format(Format):
    """One HDF5 file per task: `task_00000.hdf5` and so on."""

    name = "hdf5"

    def place(self, selection: Selection, task: Task) -> str:
        return f"task_{task.index:05d}.hdf5"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        import h5py

        require_room_for(path)
        with h5py.File(path, "x") as file:
            file.attrs.update(task_attributes(selection, task, layout=LAYOUT, version=FORMAT_VERSION))
            steps = [key.step for key in selection.parts[task.index]]
            file.attrs["snapshots"] = np.array(steps, dtype=np.int64)
            groups = file.create_group("episodes")
            for key in selection.parts[task.index]:
                trajectories = selection.dataset.trajectories(*key)
                require_room_for(path, trajectories)
                first = len(groups)
                _append(file, flat_arrays(trajectories, first=first, step=key.step))
                for index, trajectory in enumerate(trajectories, start=first):
                    _write_episode(groups.create_group(f"{index:06d}"), trajectory, key.step)
                file.flush()  # what the file keeps in memory is counted as room otherwise
                yield key


def read_hdf5(path: str | Path) -> list[Trajectory]:
    """The episodes of a file that `Hdf5Format` wrote, in order.

    Raises:
        StoreError: the file is missing, no HDF5, or of another format version.

    Example:
        >>> from tcmrl_data.interchange.formats.hdf5 import read_hdf5
        >>> episodes = read_hdf5("data/point-robot-hdf5/task_00000.hdf5")  # doctest: +SKIP
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            version = file.attrs.get("format_version")
            if version != FORMAT_VERSION or "episodes" not in file:
                raise StoreError(
                    f"{path}: format_version {version} is not {FORMAT_VERSION}, which this version reads"
                )
            return [_read_episode(group) for _, group in sorted(file["episodes"].items())]
    except OSError as error:
        raise StoreError(f"{path} does not open as HDF5 ({error}); export the dataset again") from None


def flat_arrays(
    trajectories: Sequence[Trajectory], *, first: int, step: int
) -> dict[str, npt.NDArray[np.generic]]:
    """Transitions of a part behind one another.

    Args:
        trajectories: of the part.
        first: number of its first episode.
        step: its snapshot's.
    """
    lengths = [len(trajectory) for trajectory in trajectories]
    arrays: dict[str, npt.NDArray[np.generic]] = {
        "observations": np.concatenate([trajectory.observations[:-1] for trajectory in trajectories]),
        "next_observations": np.concatenate([trajectory.observations[1:] for trajectory in trajectories]),
        "actions": np.concatenate([trajectory.actions for trajectory in trajectories]),
        "rewards": np.concatenate([trajectory.rewards for trajectory in trajectories]),
        "terminals": np.concatenate([trajectory.terminated for trajectory in trajectories]),
        "timeouts": np.concatenate([trajectory.truncated for trajectory in trajectories]),
        "episode": np.repeat(np.arange(first, first + len(lengths), dtype=np.int64), lengths),
        "step": np.full(sum(lengths), step, dtype=np.int64),
    }
    extras = {
        name: [trajectory.extras[name] for trajectory in trajectories] for name in trajectories[0].extras
    }
    return arrays | {name: np.concatenate(values) for name, values in extras.items()}


def _append(file: "h5py.File", arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
    for name, array in arrays.items():
        if name not in file:
            file.create_dataset(
                name,
                shape=(0, *array.shape[1:]),
                maxshape=(None, *array.shape[1:]),
                dtype=array.dtype,
                chunks=(CHUNK_ROWS, *array.shape[1:]),
                compression="gzip",
                compression_opts=1,
                shuffle=True,
                fletcher32=True,
            )
        rows = len(file[name])
        file[name].resize(rows + len(array), axis=0)
        file[name][rows:] = array


def _write_episode(group: "h5py.Group", trajectory: Trajectory, step: int) -> None:
    group.attrs["step"] = step
    group.attrs["return"] = trajectory.undiscounted_return
    arrays = {name: getattr(trajectory, name) for name in EPISODE_ARRAYS} | dict(trajectory.extras)
    for name, array in arrays.items():
        group.create_dataset(name, data=array)


def _read_episode(group: "h5py.Group") -> Trajectory:
    arrays = {name: np.asarray(values[()]) for name, values in group.items()}
    extras = {name: array for name, array in arrays.items() if name not in EPISODE_ARRAYS}
    observations, actions, rewards, terminated, truncated = (arrays[name] for name in EPISODE_ARRAYS)
    return Trajectory(observations, actions, rewards, terminated, truncated, extras)
