"""Minari datasets in their HDF5 storage, read without Minari.

A dataset is a folder with `data/metadata.json` and `data/main_data.hdf5`, and is one task. Observations and
actions are arrays, or a flat dictionary of arrays, which are put side by side. Infos of rank 1 become further
per-step arrays without their first row, which is the reset's; others are left out.

Datasets that `tcmrl-data export --format minari` wrote say task, parameters and snapshot steps.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import MAX_JSON_BYTES, parse_json
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line, read_plain_file
from tcmrl_data.interchange.formats.minari import FORMAT_VERSION, METADATA_KEY, STEP_ATTRIBUTE
from tcmrl_data.interchange.readers.base import (
    FileTask,
    ObservationOptions,
    Reader,
    ReadPart,
    Say,
    described_task,
    say_nothing,
)
from tcmrl_data.interchange.readers.episodes import Cuts, episode, extras_of, last_flags, parts_by_step
from tcmrl_data.interchange.readers.hdf5_file import Hdf5File
from tcmrl_data.interchange.readers.source_files import require_own_file

METADATA, CONTENT = "metadata.json", "main_data.hdf5"
_EPISODE = re.compile(r"episode_([0-9]{1,9})")


@final
class MinariReader(Reader):
    """A path is the folder of a dataset, such as `~/.minari/datasets/mujoco/hopper/medium-v0`."""

    name = "minari"
    Options = ObservationOptions
    options: ObservationOptions

    def files(self, path: Path) -> list[Path]:
        files = [_data_folder(path) / name for name in (CONTENT, METADATA)]
        for file in files:
            require_own_file(file)
        return files

    def read(self, path: Path, say: Say = say_nothing) -> Iterator[ReadPart]:
        content, metadata = self.files(path)
        task, about = _task(_metadata(metadata), metadata)
        cuts = Cuts()
        with Hdf5File(content) as file:
            names = [name for name in file.members("/") if _EPISODE.fullmatch(name)]
            names.sort(key=lambda name: int(name.removeprefix("episode_")))
            episodes = (
                (file.index(f"/{name}", STEP_ATTRIBUTE, 0), self._episode(file, f"/{name}", cuts))
                for name in names
            )
            for step, trajectories in parts_by_step(episodes, place=str(content)):
                yield ReadPart(task, step, trajectories, about)
        for sentence in cuts.sentences():
            say(f"{path.name}: {sentence}")

    def _episode(self, file: Hdf5File, group: str, cuts: Cuts) -> Trajectory:
        place = f"{file.path}: {group}"
        flags = last_flags(file.array(f"{group}/terminations"), file.array(f"{group}/truncations"), place)
        return episode(
            _columns(file, f"{group}/observations", self.options.keys()),
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


def _task(metadata: Mapping[str, Any], file: Path) -> tuple[int | None, FileTask]:
    """The task of a dataset that was exported here; nothing for any other."""
    text = metadata.get(METADATA_KEY)
    if text is None:
        return None, FileTask()
    return described_task(text, version=FORMAT_VERSION, place=str(file))


def _columns(file: Hdf5File, path: str, keys: Sequence[str] | None) -> npt.NDArray[Any]:
    """An array of (rows, columns), or those of a group side by side."""
    return file.columns(path, keys or file.members(path)) if file.is_group(path) else file.array(path)


def _infos(file: Hdf5File, group: str) -> dict[str, npt.NDArray[Any]]:
    """Infos that a part may have, without the row of the reset."""
    if not file.is_group(f"{group}/infos"):
        return {}
    steps = file.length(f"{group}/rewards")
    names = [name for name in file.members(f"{group}/infos") if file.rank(f"{group}/infos/{name}") == 1]
    arrays = {name: file.array(f"{group}/infos/{name}") for name in names}
    kept = {name: array[1:] if len(array) == steps + 1 else array for name, array in arrays.items()}
    return extras_of({name: array for name, array in kept.items() if len(array) == steps})
