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
from typing import Literal, final

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.formats.hdf5 import EPISODE_ARRAYS, FORMAT_VERSION, LAYOUT
from tcmrl_data.interchange.formats.robomimic import FORMAT_VERSION as ROBOMIMIC_VERSION
from tcmrl_data.interchange.formats.robomimic import LAYOUT as OUR_ROBOMIMIC
from tcmrl_data.interchange.formats.robomimic import STEP_ATTRIBUTE
from tcmrl_data.interchange.readers.base import (
    TASK_ATTRIBUTES,
    FileTask,
    ObservationOptions,
    Reader,
    ReadPart,
    Say,
    described_task,
    say_nothing,
)
from tcmrl_data.interchange.readers.episodes import (
    Cuts,
    episode,
    episodes_of_rows,
    extras_of,
    joined_observations,
    last_flags,
    parts_by_step,
)
from tcmrl_data.interchange.readers.hdf5_file import Hdf5File
from tcmrl_data.interchange.readers.source_files import require_file

Layout = Literal["tcmrl", "d4rl", "robomimic"]
D4RL_ARRAYS = ("observations", "actions", "rewards", "terminals")
D4RL_OPTIONAL = ("timeouts", "next_observations")
OUR_DEMONSTRATION = ("actions", "rewards", "dones", "terminated", "truncated")
ROBOMIMIC_FLAGS = ("terminated", "truncated", "dones")
"""The first two are not robomimic's own, but say what `dones` leaves open."""

_DEMO = re.compile(r"demo_([0-9]{1,9})")


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
        keys = self.options.keys() or _low_dimensional(file, f"/data/{names[0]}/obs")
        is_ours = file.attribute("/", "format") == OUR_ROBOMIMIC
        task, about = _task(file, ROBOMIMIC_VERSION) if is_ours else (None, FileTask())
        read = _our_demonstration if is_ours else _demonstration
        episodes = (
            (file.index(f"/data/{name}", STEP_ATTRIBUTE) if is_ours else 0, trajectory)
            for name in names
            for trajectory in read(file, f"/data/{name}", keys, cuts)
        )
        for step, trajectories in parts_by_step(episodes, place=str(file.path)):
            yield ReadPart(task, step, trajectories, about)


def _layout_of(file: Hdf5File) -> Layout:
    """The layout that the file's content suggests.

    Raises:
        StoreError: none of the three.
    """
    if file.attribute("/", "format") == LAYOUT:
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
    task, about = _task(file, FORMAT_VERSION)
    groups = (f"/episodes/{name}" for name in file.members("/episodes"))
    episodes = ((file.index(group, "step"), _our_episode(file, group, cuts)) for group in groups)
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


def _task(file: Hdf5File, version: int) -> tuple[int, FileTask]:
    """The task that the attributes of an exported file name."""
    attributes = {name: file.attribute("/", name) for name in TASK_ATTRIBUTES}
    return described_task(attributes, version=version, place=str(file.path))


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
    flags = {name: file.array(f"{group}/{name}") for name in ROBOMIMIC_FLAGS if file.holds(f"{group}/{name}")}
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
    file: Hdf5File, group: str, keys: tuple[str, ...], cuts: Cuts
) -> tuple[Trajectory, ...]:
    """A demonstration that `RobomimicFormat` wrote, with its flags and further arrays."""
    place = f"{file.path}: {group}"
    arrays = {
        name: file.array(f"{group}/{name}") for name in file.members(group) if file.rank(f"{group}/{name}")
    }
    missing = [name for name in OUR_DEMONSTRATION if name not in arrays]
    if missing:
        raise StoreError(f"{place}/{missing[0]} is missing")
    actions, rewards, _, terminated, truncated = (arrays.pop(name) for name in OUR_DEMONSTRATION)
    both = (file.columns(f"{group}/{name}", keys) for name in ("obs", "next_obs"))
    made = episode(
        joined_observations(*both, place=place),
        actions,
        rewards,
        ended=last_flags(terminated, truncated, place),
        extras=extras_of(arrays),
        cuts=cuts,
        place=place,
    )
    return (made,)
