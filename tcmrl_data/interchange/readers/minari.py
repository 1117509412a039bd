"""Minari datasets in their HDF5 storage, read without Minari.

A dataset is a folder with `data/metadata.json` and `data/main_data.hdf5`, and is one task. Observations and
actions are arrays, or a flat dictionary of arrays, which are put side by side. Infos of rank 1 become further
per-step arrays without their first row, which is the reset's; others are left out.

Datasets that `tcmrl-data export --format minari` wrote say task, parameters and snapshot steps.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import MAX_JSON_BYTES, parse_json
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line, read_plain_file
from tcmrl_data.interchange.readers.base import (
    FileTask,
    Reader,
    ReaderOptions,
    ReadPart,
    Say,
    say_nothing,
)
from tcmrl_data.interchange.readers.episodes import Cuts, episode, extras_of, last_flags, parts_by_step
from tcmrl_data.interchange.readers.hdf5_file import Hdf5File
from tcmrl_data.interchange.readers.source_files import require_own_file
from tcmrl_data.store.limits import MAX_INDEX

METADATA, CONTENT = "metadata.json", "main_data.hdf5"
STEP_ATTRIBUTE = "snapshot_step"
_EPISODE = re.compile(r"episode_([0-9]{1,9})")
_TASK = re.compile(r"tcmrl/.+-task([0-9]{5,9})-v0")


class MinariOptions(ReaderOptions):
    """Options of the Minari reader.

    Attributes:
        observation_keys: of a dictionary of observations, those that are put side by side, separated by
            commas; all, sorted by name, where unset.
    """

    observation_keys: str | None = None


@final
class MinariReader(Reader):
    """A path is the folder of a dataset, such as `~/.minari/datasets/mujoco/hopper/medium-v0`."""

    name = "minari"
    Options = MinariOptions
    options: MinariOptions

    def files(self, path: Path) -> list[Path]:
        files = [_data_folder(path) / name for name in (CONTENT, METADATA)]
        for file in files:
            require_own_file(file)
        return files

    def read(self, path: Path, say: Say = say_nothing) -> Iterator[ReadPart]:
        content, metadata = self.files(path)
        task, about = _task(_metadata(metadata))
        cuts = Cuts()
        with Hdf5File(content) as file:
            names = [name for name in file.members("/") if _EPISODE.fullmatch(name)]
            names.sort(key=lambda name: int(name.removeprefix("episode_")))
            episodes = ((_step(file, name), self._episode(file, f"/{name}", cuts)) for name in names)
            for step, trajectories in parts_by_step(episodes, place=str(content)):
                yield ReadPart(task, step, trajectories, about)
        for sentence in cuts.sentences():
            say(f"{path.name}: {sentence}")

    def _episode(self, file: Hdf5File, group: str, cuts: Cuts) -> Trajectory:
        place = f"{file.path}: {group}"
        flags = last_flags(file.array(f"{group}/terminations"), file.array(f"{group}/truncations"), place)
        keys = self.options.observation_keys
        return episode(
            _columns(file, f"{group}/observations", keys.split(",") if keys else None),
            _columns(file, f"{group}/actions", None),
            file.array(f"{group}/rewards"),
            ended=flags,
            extras=_infos(file, group),
            cuts=cuts,
            place=place,
        )


def _data_folder(path: Path) -> Path:
    """The folder of the two files.

    Raises:
        StoreError: there is none.
    """
    resolved = path.resolve()
    for folder in (resolved / "data", resolved):
        if (folder / METADATA).is_file():
            if folder.is_symlink():
                raise StoreError(f"{folder} is a link, not a folder; replace it by a copy")
            return folder
    raise StoreError(f"{path}: holds no data/{METADATA}; name the folder of a Minari dataset")


def _metadata(file: Path) -> Mapping[str, Any]:
    try:
        values = parse_json(read_plain_file(file, limit=MAX_JSON_BYTES).replace(b"Infinity", b"0"))
    except (OSError, ValueError) as error:
        raise StoreError(f"{file}: not Minari's metadata ({one_line(error)})") from None
    if not isinstance(values, dict):
        raise StoreError(f"{file}: not Minari's metadata (no table)")
    if values.get("data_format", "hdf5") != "hdf5":
        found = repr(values["data_format"])[:40]
        raise StoreError(
            f"{file}: data_format is {found}, only hdf5 is read; convert the dataset with Minari"
        )
    return values


def _task(metadata: Mapping[str, Any]) -> tuple[int | None, FileTask]:
    """The task of a dataset that was exported here; nothing for any other."""
    try:
        spec = parse_json(metadata["env_spec"].encode())
        index = int(_TASK.fullmatch(spec["id"])[1])  # type: ignore[index]
        parameters = spec["kwargs"]["parameters"]
    except (ValueError, KeyError, TypeError, AttributeError):
        return None, FileTask()
    return (index, FileTask(parameters=parameters)) if isinstance(parameters, dict) else (None, FileTask())


def _step(file: Hdf5File, name: str) -> int:
    value = file.attribute(f"/{name}", STEP_ATTRIBUTE)
    if value is None:
        return 0
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < MAX_INDEX:
        raise StoreError(f"{file.path}: /{name} attribute {STEP_ATTRIBUTE} is {repr(value)[:40]}, not a step")
    return value


def _columns(file: Hdf5File, path: str, keys: list[str] | None) -> npt.NDArray[Any]:
    """An array of (rows, columns), or those of a group side by side."""
    if not file.is_group(path):
        return file.array(path)
    members = [file.array(f"{path}/{key}") for key in keys or file.members(path)]
    members = [member[:, None] if member.ndim == 1 else member for member in members]
    if not members or any(member.ndim != 2 or len(member) != len(members[0]) for member in members):
        raise StoreError(
            f"{file.path}: {path} is no flat dictionary of rows; choose some by --option observation_keys=A,B"
        )
    return np.concatenate(members, axis=1)


def _infos(file: Hdf5File, group: str) -> dict[str, npt.NDArray[Any]]:
    """Infos that a part may have, without the row of the reset."""
    if not file.is_group(f"{group}/infos"):
        return {}
    steps = file.length(f"{group}/rewards")
    names = [name for name in file.members(f"{group}/infos") if file.rank(f"{group}/infos/{name}") == 1]
    arrays = {name: file.array(f"{group}/infos/{name}") for name in names}
    kept = {name: array[1:] if len(array) == steps + 1 else array for name, array in arrays.items()}
    return extras_of({name: array for name, array in kept.items() if len(array) == steps})
