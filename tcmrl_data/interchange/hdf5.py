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

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal, final

import h5py
import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import Format, episode_arrays, transitions
from tcmrl_data.interchange.hdf5_file import Hdf5File
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    FileTask,
    ObservationOptions,
    Reader,
    ReadPart,
    Say,
    episodes_of_rows,
    parts_of_task,
    stored_episode,
)
from tcmrl_data.interchange.robomimic import read_robomimic
from tcmrl_data.store.tables import PartKey

Layout = Literal["tcmrl", "d4rl", "robomimic"]

CHUNK_ROWS = 4_096
FLAT_NAMES = {"terminated": "terminals", "truncated": "timeouts"}
D4RL_ARRAYS = ("observations", "actions", "rewards", "terminals")
D4RL_OPTIONAL = ("timeouts", "next_observations")


@final
class Hdf5Format(Format):
    """One HDF5 file per task: `task_00000.hdf5` and so on."""

    name = "hdf5"
    suffix = ".hdf5"
    takes_empty_episodes = True

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        with h5py.File(path, "x") as file:
            file.attrs.update(self.attributes(selection, task))
            steps = [key.step for key in selection.parts[task.index]]
            file.attrs["snapshots"] = np.array(steps, dtype=np.int64)
            groups = file.create_group("episodes")
            for key, trajectories in self.parts(selection, task, path):
                first = len(groups)
                _append(file, transitions(trajectories, first=first, step=key.step))
                for index, trajectory in enumerate(trajectories, start=first):
                    group = groups.create_group(f"{index:06d}")
                    group.attrs["step"] = key.step
                    group.attrs["return"] = trajectory.undiscounted_return
                    for name, array in episode_arrays(trajectory).items():
                        group.create_dataset(name, data=array)
                file.flush()  # what the file keeps in memory is counted as room otherwise
                yield key


def _append(file: h5py.File, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
    for name, array in arrays.items():
        flat = file.get(FLAT_NAMES.get(name, name))
        if flat is None:
            flat = file.create_dataset(
                FLAT_NAMES.get(name, name),
                shape=(0, *array.shape[1:]),
                maxshape=(None, *array.shape[1:]),
                dtype=array.dtype,
                chunks=(CHUNK_ROWS, *array.shape[1:]),
                compression="gzip",
                compression_opts=1,
                shuffle=True,
                fletcher32=True,
            )
        rows = len(flat)
        flat.resize(rows + len(array), axis=0)
        flat[rows:] = array


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

    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        cuts = EpisodeCuts()
        with Hdf5File(path) as file:
            layout = self.options.layout or _layout_of(file)
            if layout == "robomimic":
                yield from read_robomimic(file, self.options.keys(), cuts)
            elif layout == "tcmrl":
                yield from _read_ours(file, cuts)
            else:
                arrays = {name: file.array(f"/{name}") for name in D4RL_ARRAYS}
                optional = [name for name in D4RL_OPTIONAL if file.rank(f"/{name}") is not None]
                arrays |= {name: file.array(f"/{name}") for name in optional}
                yield ReadPart(FileTask(), 0, episodes_of_rows(arrays, cuts=cuts, place=str(path)))
        cuts.tell(say, path)


def _layout_of(file: Hdf5File) -> Layout:
    """The layout that the file's content suggests.

    Raises:
        StoreError: none of the three.
    """
    if file.attribute("/", "format") == "tcmrl-hdf5":
        return "tcmrl"
    names = file.members("/")
    missing = ", ".join(f"/{name}" for name in D4RL_ARRAYS if name not in names)
    if not missing:
        return "d4rl"
    if file.members("/data"):
        return "robomimic"
    raise StoreError(
        f"{file.path}: is of no known layout (d4rl: {missing} missing; robomimic: /data missing; tcmrl: "
        "attribute format missing); name one with --option layout=NAME"
    )


def _read_ours(file: Hdf5File, cuts: EpisodeCuts) -> Iterator[ReadPart]:
    task = file.task()
    groups = [f"/episodes/{name}" for name in file.members("/episodes")]
    episodes = (
        (
            file.step(group, "step"),
            stored_episode(
                {name: file.array(f"{group}/{name}") for name in file.members(group)},
                cuts=cuts,
                place=f"{file.path}: {group}",
            ),
        )
        for group in groups
    )
    return parts_of_task(episodes, task, place=str(file.path))
