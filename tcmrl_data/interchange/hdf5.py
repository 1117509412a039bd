"""HDF5, one file per task: flat arrays in the manner of D4RL, and where each episode lies in them.

```
/observations /actions /rewards /next_observations    (N, …) float32, all episodes behind one another
/terminals /timeouts                                  (N,) bool; a time limit is never a terminal
/episode /step                                        (N,) int64: number of the episode, its snapshot's step
/success …                                            (N,) further per-step arrays, where the dataset has them
/episodes/{length, step} (E,) int64, return (E,)      of every episode; `return` is undiscounted
/episodes/final_observation (E, …)                    after the last step of every episode
```

All are compressed by gzip in chunks of at most 1 MiB. Attributes of the file name the environment, the task
with its parameters and split, the seed, and the dataset it came from.

Three layouts are read, which are told apart by what a file holds. `tcmrl`: the one above. `d4rl`: flat arrays
of one task, `/observations /actions /rewards /terminals` and, where there are any, `/timeouts
/next_observations`; other arrays are left out. `robomimic`: see `robomimic.py`.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, final

import h5py
import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import Format, transitions
from tcmrl_data.interchange.hdf5_file import Hdf5File, new_file
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    FileTask,
    ObservationOptions,
    Reader,
    ReadPart,
    Say,
    checked_index,
    damage_at,
    episodes_of_rows,
    parts_of_task,
    stored_episode,
)
from tcmrl_data.interchange.robomimic import read_robomimic
from tcmrl_data.store.tables import PartKey

Layout = Literal["tcmrl", "d4rl", "robomimic"]

CHUNK_ROWS, CHUNK_BYTES = 4_096, 2**20
"""The most of a chunk; HDF5 keeps one of 1 MiB in memory while it is filled."""

FLAT_NAMES = {"terminated": "terminals", "truncated": "timeouts"}
FOR_FLAT_READERS = ("next_observations", "episode", "step")
"""Arrays that `/episodes` says too."""

D4RL_ARRAYS = ("observations", "actions", "rewards", "terminals")
D4RL_OPTIONAL = ("timeouts", "next_observations")


@final
class Hdf5Format(Format):
    """One HDF5 file per task: `task_00000.hdf5` and so on."""

    name = "hdf5"
    suffix = ".hdf5"
    takes_empty_episodes = True

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        with new_file(path, "x") as file:
            file.attrs.update(self.attributes(selection, task))
            steps = [key.step for key in selection.parts[task.index]]
            file.attrs["snapshots"] = np.array(steps, dtype=np.int64)
            episodes = 0
            for key, trajectories in self.parts(selection, task, path):
                _append(file, transitions(trajectories, first=episodes, step=key.step))
                _append(file.require_group("episodes"), _index(trajectories, key.step))
                episodes += len(trajectories)
                file.flush()  # what the file keeps in memory is counted as room otherwise
                yield key


def _index(trajectories: Sequence[Trajectory], step: int) -> dict[str, npt.NDArray[Any]]:
    """What finds the episodes of a part in the flat arrays and completes them."""
    return {
        "length": np.array([len(trajectory) for trajectory in trajectories], dtype=np.int64),
        "step": np.full(len(trajectories), step, dtype=np.int64),
        "return": np.array([trajectory.undiscounted_return for trajectory in trajectories]),
        "final_observation": np.stack([trajectory.observations[-1] for trajectory in trajectories]),
    }


def _append(group: h5py.Group, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    for name, array in arrays.items():
        flat = group.get(FLAT_NAMES.get(name, name))
        if flat is None:
            row_bytes = array.itemsize * math.prod(array.shape[1:])
            rows = min(CHUNK_ROWS, max(1, CHUNK_BYTES // max(1, row_bytes)))
            flat = group.create_dataset(
                FLAT_NAMES.get(name, name),
                shape=(0, *array.shape[1:]),
                maxshape=(None, *array.shape[1:]),
                dtype=array.dtype,
                chunks=(rows, *array.shape[1:]),
                compression="gzip",
                compression_opts=1,
                shuffle=True,
                fletcher32=True,
            )
        rows = len(flat)
        flat.resize(rows + len(array), axis=0)
        flat[rows:] = array


@final
class Hdf5Reader(Reader):
    """One file is one task; the option `observation_keys` is of robomimic's layout."""

    name = "hdf5"
    Options = ObservationOptions
    options: ObservationOptions

    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        cuts = EpisodeCuts()
        with Hdf5File(path) as file:
            layout = _layout_of(file)
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
        "attribute format missing)"
    )


def _read_ours(file: Hdf5File, cuts: EpisodeCuts) -> Iterator[ReadPart]:
    lengths, steps, final = (
        file.array(f"/episodes/{name}") for name in ("length", "step", "final_observation")
    )
    stored = {flat: name for name, flat in FLAT_NAMES.items()}
    names = [name for name in file.members("/") if file.rank(f"/{name}") and name not in FOR_FLAT_READERS]
    arrays = {stored.get(name, name): file.array(f"/{name}") for name in names}
    place = f"{file.path}: /episodes"
    with damage_at(f"{place}:"):
        stops = list(itertools.accumulate(lengths.tolist(), initial=0))
        if not len(lengths) == len(steps) == len(final) or {lengths.dtype.kind, steps.dtype.kind} - set("iu"):
            raise ValueError("length, step and final_observation do not belong together")
        if stops != sorted(stops) or any(len(array) != stops[-1] for array in arrays.values()):
            raise ValueError("length does not add up to the rows of every array")

    def episodes() -> Iterator[tuple[int, Trajectory]]:
        for index, (start, stop) in enumerate(itertools.pairwise(stops)):
            rows = {name: array[start:stop] for name, array in arrays.items()}
            with damage_at(f"{place}: {index}:"):
                rows["observations"] = np.concatenate([rows["observations"], final[index : index + 1]])
            step = checked_index(int(steps[index]), f"{place}/step")
            yield step, stored_episode(rows, cuts=cuts, place=f"{place}: {index}")

    return parts_of_task(episodes(), file.task(), place=str(file.path))
