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

Three layouts are read, which are told apart by what a file holds. `tcmrl`: the one above, of which the groups
are read. `d4rl`: flat arrays of one task, `/observations /actions /rewards /terminals` and, where there are
any, `/timeouts /next_observations`; other arrays are left out. `robomimic`: see `robomimic.py`.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, final

import h5py
import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import Format, require_room_for, task_attributes
from tcmrl_data.interchange.hdf5_file import Hdf5File
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    ObservationOptions,
    Reader,
    ReadPart,
    Say,
    episode_of,
    episodes_of_rows,
    extras_of,
    last_flags,
    parts_of_task,
    require_file,
)
from tcmrl_data.interchange.robomimic import read_robomimic
from tcmrl_data.store.keys import PartKey

Layout = Literal["tcmrl", "d4rl", "robomimic"]

LAYOUT, FORMAT_VERSION = "tcmrl-hdf5", 1
EPISODE_ARRAYS = ("observations", "actions", "rewards", "terminated", "truncated")
CHUNK_ROWS = 4_096
D4RL_ARRAYS = ("observations", "actions", "rewards", "terminals")
D4RL_OPTIONAL = ("timeouts", "next_observations")


@final
class Hdf5Format(Format):
    """One HDF5 file per task: `task_00000.hdf5` and so on."""

    name = "hdf5"

    def place(self, selection: Selection, task: Task) -> str:
        return f"task_{task.index:05d}.hdf5"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
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
                _append(file, _flat_arrays(trajectories, first=first, step=key.step))
                for index, trajectory in enumerate(trajectories, start=first):
                    _write_episode(groups.create_group(f"{index:06d}"), trajectory, key.step)
                file.flush()  # what the file keeps in memory is counted as room otherwise
                yield key


def _flat_arrays(
    trajectories: Sequence[Trajectory], *, first: int, step: int
) -> dict[str, npt.NDArray[np.generic]]:
    """Transitions of a part behind one another; `first` numbers its first episode."""
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
    for name in trajectories[0].extras:
        arrays[name] = np.concatenate([trajectory.extras[name] for trajectory in trajectories])
    return arrays


def _append(file: h5py.File, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
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


def _write_episode(group: h5py.Group, trajectory: Trajectory, step: int) -> None:
    group.attrs["step"] = step
    group.attrs["return"] = trajectory.undiscounted_return
    arrays = {name: getattr(trajectory, name) for name in EPISODE_ARRAYS} | dict(trajectory.extras)
    for name, array in arrays.items():
        group.create_dataset(name, data=array)


def read_hdf5(path: str | Path) -> list[Trajectory]:
    """The episodes of a file that `Hdf5Format` wrote, in order; those without steps too.

    Raises:
        StoreError: the file is missing, no HDF5, or of another format version.

    Example:
        >>> from tcmrl_data.interchange.hdf5 import read_hdf5
        >>> episodes = read_hdf5("data/point-robot-hdf5/task_00000.hdf5")  # doctest: +SKIP
    """
    try:
        with h5py.File(path, "r") as file:
            version = file.attrs.get("format_version")
            if version != FORMAT_VERSION or "episodes" not in file:
                raise StoreError(
                    f"{path}: format_version {version} is not {FORMAT_VERSION}, which this version reads"
                )
            return [_stored_episode(group) for _, group in sorted(file["episodes"].items())]
    except OSError as error:
        raise StoreError(f"{path} does not open as HDF5 ({error}); export the dataset again") from None


def _stored_episode(group: h5py.Group) -> Trajectory:
    arrays = {name: np.asarray(values[()]) for name, values in group.items()}
    observations, actions, rewards, terminated, truncated = (arrays.pop(name) for name in EPISODE_ARRAYS)
    return Trajectory(observations, actions, rewards, terminated, truncated, arrays)


class Hdf5Options(ObservationOptions):
    """Options of the HDF5 reader; `observation_keys` are those of robomimic's layout.

    Attributes:
        layout: of the file, instead of the one that its content suggests.
    """

    layout: Layout | None = None


@final
class Hdf5Reader(Reader):
    """One file is one task."""

    name = "hdf5"
    Options = Hdf5Options
    options: Hdf5Options

    def files(self, path: Path) -> list[Path]:
        return [require_file(path)]

    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        cuts = EpisodeCuts()
        with Hdf5File(path) as file:
            layout = self.options.layout or _layout_of(file)
            if layout == "robomimic":
                yield from read_robomimic(file, self.options.keys(), cuts)
            else:
                yield from (_read_ours if layout == "tcmrl" else _read_d4rl)(file, cuts)
        cuts.tell(say, path)


def _layout_of(file: Hdf5File) -> Layout:
    """The layout that the file's content suggests.

    Raises:
        StoreError: none of the three.
    """
    if file.attribute("/", "format") == LAYOUT:
        return "tcmrl"
    missing = ", ".join(f"/{name}" for name in D4RL_ARRAYS if not file.holds(f"/{name}"))
    if not missing:
        return "d4rl"
    if file.is_group("/data"):
        return "robomimic"
    raise StoreError(
        f"{file.path}: is of no known layout (d4rl: {missing} missing; robomimic: /data missing; tcmrl: "
        "attribute format missing); name one with --option layout=NAME"
    )


def _read_ours(file: Hdf5File, cuts: EpisodeCuts) -> Iterator[ReadPart]:
    task, about = file.task(version=FORMAT_VERSION)
    groups = (f"/episodes/{name}" for name in file.members("/episodes"))
    episodes = ((file.index(group, "step"), _read_episode(file, group, cuts)) for group in groups)
    return parts_of_task(episodes, task, about, place=str(file.path))


def _read_episode(file: Hdf5File, group: str, cuts: EpisodeCuts) -> Trajectory:
    arrays = {name: file.array(f"{group}/{name}") for name in file.members(group)}
    place = f"{file.path}: {group}"
    missing = [name for name in EPISODE_ARRAYS if name not in arrays]
    if missing:
        raise StoreError(f"{place}/{missing[0]} is missing")
    observations, actions, rewards, terminated, truncated = (arrays.pop(name) for name in EPISODE_ARRAYS)
    ended = last_flags(terminated, truncated, place)
    extras = extras_of(arrays)
    return episode_of(observations, actions, rewards, ended=ended, extras=extras, cuts=cuts, place=place)


def _read_d4rl(file: Hdf5File, cuts: EpisodeCuts) -> Iterator[ReadPart]:
    optional = {name: file.array(f"/{name}") if file.holds(f"/{name}") else None for name in D4RL_OPTIONAL}
    observations, actions, rewards, terminals = (file.array(f"/{name}") for name in D4RL_ARRAYS)
    trajectories = episodes_of_rows(
        observations=observations,
        actions=actions,
        rewards=rewards,
        terminals=terminals,
        timeouts=optional["timeouts"],
        next_observations=optional["next_observations"],
        cuts=cuts,
        place=str(file.path),
    )
    yield ReadPart(None, 0, trajectories)
