"""The `.npy` files of IDAQ, FOCAL, CSRO and TCMRL: one folder per task, one file per episode.

`goal_idx3/trj_evalsample7_step50000.npy` is episode 7 of the stochastic policy of task 3 after 50,000 steps,
`trj_eval7_step50000.npy` of the deterministic one. A file is an object array of rows [observation, action,
reward, next observation], that is a pickle, which `restricted_pickle` reads without running it.

The files know no flags. Episodes of the published data end with the time limit, so every last step is marked
as truncated, and the import says so.
"""

import os
import re
import stat
from collections import defaultdict
from collections.abc import Iterator, Sequence
from math import prod
from pathlib import Path
from typing import Any, Literal, NamedTuple, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line, printable, read_plain_file
from tcmrl_data.interchange.readers.base import Reader, ReaderOptions, ReadPart, Say, say_nothing
from tcmrl_data.interchange.readers.episodes import Cuts, episodes_of_rows
from tcmrl_data.interchange.readers.restricted_pickle import (
    PickledArray,
    PickleRefusedError,
    unpickle_array,
)
from tcmrl_data.interchange.readers.source_files import decoded_limit, require_own_file

Policy = Literal["sample", "deterministic"]

LARGEST_FILE = 2**22
"""Bytes of one episode's file; those that were published have at most a few hundred kilobytes."""

COLUMNS = 4
MAGIC = b"\x93NUMPY"
LARGEST_HEADER = 2**10
_HEADER = re.compile(rb"\{'descr': '\|O', 'fortran_order': False, 'shape': \((\d{1,9}), 4\), \} *\n")
_TASK = re.compile(r"goal_idx([0-9]{1,9})")
_EPISODE = re.compile(r"trj_eval(sample)?([0-9]{1,9})_step([0-9]{1,9})\.npy")


class IdaqNpyOptions(ReaderOptions):
    """Options of the reader.

    Attributes:
        episodes: of the stochastic or of the deterministic policy; the stochastic one's where unset, or
            the deterministic one's where a task has no others.
    """

    episodes: Policy | None = None


class _File(NamedTuple):
    """An episode's file, as its name tells."""

    task: int
    step: int
    number: int
    policy: Policy
    path: Path


@final
class IdaqNpyReader(Reader):
    """A path is the folder that holds `goal_idx0` and so on."""

    name = "idaq-npy"
    Options = IdaqNpyOptions
    options: IdaqNpyOptions

    def files(self, path: Path) -> list[Path]:
        return [file.path for file in self._chosen(path, say_nothing)]

    def read(self, path: Path, say: Say = say_nothing) -> Iterator[ReadPart]:
        parts: dict[tuple[int, int], list[_File]] = defaultdict(list)
        for file in self._chosen(path, say):
            parts[file.task, file.step].append(file)
        cuts = Cuts()
        for (task, step), files in parts.items():
            yield ReadPart(task, step, [one for file in files for one in _read(file.path, cuts)])
        for sentence in cuts.sentences():
            say(f"{path.name}: {sentence}")

    def _chosen(self, path: Path, say: Say) -> list[_File]:
        """The files to read, sorted by task, step and episode."""
        found = sorted(_list(path))
        policy = self.options.episodes
        sampled = {file.task for file in found if file.policy == "sample"}
        chosen = [
            file
            for file in found
            if file.policy == (policy or ("sample" if file.task in sampled else "deterministic"))
        ]
        if not chosen:
            raise StoreError(
                f"{path}: holds no goal_idx0/trj_evalsample0_step0.npy ; name the folder of the tasks"
            )
        if len(chosen) < len(found):
            say(f"{path.name}: {len(found) - len(chosen):,} episodes of the other policy are left out")
        return chosen


def _list(path: Path) -> Iterator[_File]:
    """All episodes' files below a path.

    Raises:
        StoreError: the path is no folder, or a task's folder or an episode's file is a link.
    """
    for name in _names(path):
        match = _TASK.fullmatch(name)
        if match is None:
            continue
        folder = path / name
        if not stat.S_ISDIR(folder.lstat().st_mode):
            raise StoreError(f"{folder} is a link or a file, not a folder; replace it by a copy")
        for episode in _names(folder):
            found = _EPISODE.fullmatch(episode)
            if found is not None:
                require_own_file(folder / episode)
                policy: Policy = "sample" if found[1] else "deterministic"
                yield _File(int(match[1]), int(found[3]), int(found[2]), policy, folder / episode)


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError as error:
        raise StoreError(f"{printable(str(folder))} cannot be read ({one_line(error)})") from None


def _read(path: Path, cuts: Cuts) -> list[Trajectory]:
    """The episode of a file; several where its rows do not follow each other."""
    try:
        data = read_plain_file(path, limit=LARGEST_FILE)
        rows = _rows(data)
        observations, actions, rewards, following = (
            _column(rows, column, len(data)) for column in range(COLUMNS)
        )
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} {one_line(error)}") from None
    return episodes_of_rows(
        observations=observations,
        actions=actions,
        rewards=rewards,
        terminals=np.zeros(len(rewards), dtype=bool),
        timeouts=None,
        next_observations=following,
        cuts=cuts,
        place=str(path),
    )


def _rows(data: bytes) -> list[Sequence[Any]]:
    """The rows of a file, each of four cells.

    Raises:
        ValueError: it is no object array of rows; the message does not name the file.
    """
    shape, start = _header(data)
    array = unpickle_array(data[start:])
    if array.cells is None or array.shape != shape:
        raise PickleRefusedError(f"says shape {shape} and holds {array.shape}")
    cells = array.cells
    return [cells[row : row + COLUMNS] for row in range(0, len(cells), COLUMNS)]


def _header(data: bytes) -> tuple[tuple[int, ...], int]:
    """The shape that a file's header names, and where its content starts."""
    size = {b"\x01\x00": 2, b"\x02\x00": 4}.get(data[len(MAGIC) : len(MAGIC) + 2])
    if not data.startswith(MAGIC) or size is None:
        raise ValueError("is no .npy file of version 1.0 or 2.0")
    first = len(MAGIC) + 2 + size
    start = first + int.from_bytes(data[first - size : first], "little")
    # a pattern, since NumPy's own reader would evaluate what stands here
    match = _HEADER.fullmatch(data[first : min(start, first + LARGEST_HEADER)])
    if match is None:
        raise ValueError(f"is no object array of rows of {COLUMNS} cells [observation, action, reward, next]")
    shape = (int(match[1]), COLUMNS)
    if not 0 < prod(shape) <= len(data):
        raise ValueError(f"says shape {shape}, for which it is too short")
    return shape, start


def _column(rows: Sequence[Sequence[Any]], column: int, file_bytes: int) -> npt.NDArray[Any]:
    """One cell of all rows: numbers of (rows,), or arrays of (rows, width)."""
    cells = [_numbers(row[column]) for row in rows]
    if any(cell.shape != cells[0].shape or cell.ndim > 1 for cell in cells):
        raise ValueError(f"has cells of different shapes in column {column}")
    if len(cells) * max(cells[0].nbytes, 8) > decoded_limit(file_bytes):
        raise ValueError(f"has more values in column {column} than its size justifies")
    return np.stack(cells)


def _numbers(cell: Any) -> npt.NDArray[Any]:
    if isinstance(cell, PickledArray):
        return cell.numbers()
    if isinstance(cell, int | float):
        return np.asarray(float(cell))
    raise PickleRefusedError(f"has a cell that is {type(cell).__name__}, not a number")
