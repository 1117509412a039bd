"""HDF5 in three layouts, which are told apart by what a file holds.

`tcmrl`: what `tcmrl-data export --format hdf5` writes; the file says task, split, parameters and steps.
`d4rl`: flat arrays of one task, `/observations /actions /rewards /terminals` and, where there are any,
`/timeouts /next_observations`. Other arrays are left out.
`robomimic`: `/data/demo_0/{obs/…, next_obs/…, actions, rewards, dones}` of one task. `dones` are taken as
terminations, as robomimic's own algorithms do; one before the last step of a demonstration is left out.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import parse_json
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.formats.hdf5 import EPISODE_ARRAYS, FORMAT_VERSION
from tcmrl_data.interchange.readers.base import (
    FileTask,
    Reader,
    ReaderOptions,
    ReadPart,
    Say,
    say_nothing,
)
from tcmrl_data.interchange.readers.episodes import (
    Cuts,
    episode,
    episodes_of_rows,
    extras_of,
    last_flags,
    parts_by_step,
)
from tcmrl_data.interchange.readers.hdf5_file import Hdf5File
from tcmrl_data.interchange.readers.source_files import require_file
from tcmrl_data.store.limits import MAX_INDEX

Layout = Literal["tcmrl", "d4rl", "robomimic"]
D4RL_ARRAYS = ("observations", "actions", "rewards", "terminals")
D4RL_OPTIONAL = ("timeouts", "next_observations")
ROBOMIMIC_FLAGS = ("terminated", "truncated", "dones")
"""The first two are not robomimic's own, but say what `dones` leaves open."""

_DEMO = re.compile(r"demo_([0-9]{1,9})")


class Hdf5Options(ReaderOptions):
    """Options of the HDF5 reader.

    Attributes:
        layout: of the file, instead of the one that its content suggests.
        observation_keys: robomimic's low-dimensional observations that are put side by side, separated by
            commas; all of rank 2, sorted by name, where unset.
    """

    layout: Layout | None = None
    observation_keys: str | None = None


@final
class Hdf5Reader(Reader):
    """One file is one task."""

    name = "hdf5"
    Options = Hdf5Options
    options: Hdf5Options

    def files(self, path: Path) -> list[Path]:
        return [require_file(path)]

    def read(self, path: Path, say: Say = say_nothing) -> Iterator[ReadPart]:
        readers: Mapping[Layout, Callable[[Hdf5File, Cuts], Iterator[ReadPart]]] = {
            "tcmrl": _read_ours,
            "d4rl": _read_d4rl,
            "robomimic": self._read_robomimic,
        }
        cuts = Cuts()
        with Hdf5File(path) as file:
            yield from readers[self.options.layout or _layout_of(file)](file, cuts)
        for sentence in cuts.sentences():
            say(f"{path.name}: {sentence}")

    def _read_robomimic(self, file: Hdf5File, cuts: Cuts) -> Iterator[ReadPart]:
        names = [name for name in file.members("/data") if _DEMO.fullmatch(name)]
        names.sort(key=lambda name: int(name.removeprefix("demo_")))
        if not names:
            raise StoreError(f"{file.path}: /data holds no demo_0")
        wanted = self.options.observation_keys
        keys = tuple(wanted.split(",")) if wanted else _low_dimensional(file, f"/data/{names[0]}/obs")
        trajectories = [
            trajectory for name in names for trajectory in _demonstration(file, f"/data/{name}", keys, cuts)
        ]
        yield ReadPart(None, 0, trajectories)


def _layout_of(file: Hdf5File) -> Layout:
    """The layout that the file's content suggests.

    Raises:
        StoreError: none of the three.
    """
    if file.attribute("/", "format") == "tcmrl-hdf5":
        return "tcmrl"
    if all(file.holds(f"/{name}") for name in D4RL_ARRAYS):
        return "d4rl"
    if file.is_group("/data"):
        return "robomimic"
    missing = ", ".join(f"/{name}" for name in D4RL_ARRAYS if not file.holds(f"/{name}"))
    raise StoreError(
        f"{file.path}: is of no known layout (d4rl: {missing} missing; robomimic: /data missing; tcmrl: "
        "attribute format missing); name one with --option layout=NAME"
    )


def _read_ours(file: Hdf5File, cuts: Cuts) -> Iterator[ReadPart]:
    version = file.attribute("/", "format_version")
    if version != FORMAT_VERSION:
        raise StoreError(f"{file.path}: format_version {version} is not {FORMAT_VERSION}, which is read here")
    task, about = _index(file, "/", "task"), _about(file)
    groups = (f"/episodes/{name}" for name in file.members("/episodes"))
    episodes = ((_index(file, group, "step"), _our_episode(file, group, cuts)) for group in groups)
    for step, trajectories in parts_by_step(episodes, place=str(file.path)):
        yield ReadPart(task, step, trajectories, about)


def _our_episode(file: Hdf5File, group: str, cuts: Cuts) -> Trajectory:
    arrays = {name: file.array(f"{group}/{name}") for name in file.members(group)}
    place = f"{file.path}: {group}"
    missing = [name for name in EPISODE_ARRAYS if name not in arrays]
    if missing:
        raise StoreError(f"{place}/{missing[0]} is missing")
    observations, actions, rewards, terminated, truncated = (arrays.pop(name) for name in EPISODE_ARRAYS)
    ended = last_flags(terminated, truncated, place)
    extras = extras_of(arrays)
    return episode(observations, actions, rewards, ended=ended, extras=extras, cuts=cuts, place=place)


def _index(file: Hdf5File, path: str, name: str) -> int:
    value = file.attribute(path, name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < MAX_INDEX:
        raise StoreError(f"{file.path}: {path} attribute {name} is {repr(value)[:40]}, not an index")
    return value


def _about(file: Hdf5File) -> FileTask:
    text, split = file.attribute("/", "parameters"), file.attribute("/", "split")
    try:
        parameters: Any = parse_json(text.encode())
    except (ValueError, AttributeError):
        parameters = None
    if not isinstance(parameters, dict) or split not in ("train", "test"):
        raise StoreError(f"{file.path}: attributes parameters and split are not those of a task")
    return FileTask("test" if split == "test" else "train", parameters)


def _read_d4rl(file: Hdf5File, cuts: Cuts) -> Iterator[ReadPart]:
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


def _low_dimensional(file: Hdf5File, group: str) -> tuple[str, ...]:
    keys = tuple(name for name in file.members(group) if file.rank(f"{group}/{name}") == 2)
    if not keys:
        raise StoreError(f"{file.path}: {group} holds no observations of rank 2")
    return keys


def _demonstration(file: Hdf5File, group: str, keys: tuple[str, ...], cuts: Cuts) -> list[Trajectory]:
    def observations(kind: str) -> npt.NDArray[Any]:
        columns = [file.array(f"{group}/{kind}/{key}") for key in keys]
        for key, column in zip(keys, columns, strict=True):
            if column.ndim != 2 or len(column) != len(columns[0]):
                raise StoreError(f"{file.path}: {group}/{kind}/{key} has shape {column.shape}")
        return np.concatenate(columns, axis=1)

    flags = {name: file.array(f"{group}/{name}") for name in ROBOMIMIC_FLAGS if file.holds(f"{group}/{name}")}
    terminals = flags.get("terminated", flags.get("dones"))
    if terminals is None:
        raise StoreError(f"{file.path}: {group}/dones is missing")
    terminals = terminals.reshape(-1) != 0
    terminals[:-1] = False
    return episodes_of_rows(
        observations=observations("obs"),
        actions=file.array(f"{group}/actions"),
        rewards=file.array(f"{group}/rewards"),
        terminals=terminals,
        timeouts=flags.get("truncated"),
        next_observations=observations("next_obs") if file.is_group(f"{group}/next_obs") else None,
        cuts=cuts,
        place=f"{file.path}: {group}",
    )
