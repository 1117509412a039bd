"""The `.npy` files that the published code of FOCAL, IDAQ, CSRO and TCMRL writes and loads.

`goal_idx3/trj_evalsample7_step5000.npy` is episode 7 of the stochastic policy of a task after 5,000 steps,
`trj_eval7_step5000.npy` of the deterministic one. It is an object array of rows [observation, action, reward,
next observation], which the loaders open by `numpy.load(path, allow_pickle=True)` and index as `rows[:, 0]`.
They choose files by name (`data_dir`, `train_epoch` for the step, `n_trj` for the number of episodes) and
take the last row of each for the end of an episode, so that flags, extra arrays and runs have no place.

An export numbers its tasks from 0 without gaps, training tasks first, since the published launchers take the
first numbers for training and the last ones for test. `task_numbers.json` lists the indices of the tasks by
these numbers, and `import` gives them back. `tasks.json` lists the tasks with their splits and parameters;
`tcmrl-data import idaq-npy FOLDER --task-file FOLDER/tasks.json` reads them back.

Episodes of the published data end with the time limit, so every last step is read as truncated, and the
import says so.

An object array is a pickle, which could run anything. It is read by the standard library's unpickler with an
allow-list of the names that NumPy's arrays need. The names stand for functions of this module and not for
NumPy's own: those take a forged type's word for what is a pointer, and crash or worse. The unpickler is the
one in Python, since the one in C reserves as much memory as a pickle asks for.
"""

import json
import os
import pickle
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, Literal, NamedTuple, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import disk, named_errors
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.files import one_line, printable, read_plain_file
from tcmrl_data.foundation.records import parse_json
from tcmrl_data.interchange.exporting import REMEDY, Format
from tcmrl_data.interchange.reader import (
    DAMAGE,
    EpisodeCuts,
    FileTask,
    Reader,
    ReaderOptions,
    ReadPart,
    Say,
    damage_at,
    decoded_limit,
    episodes_of_rows,
    require_file,
)
from tcmrl_data.store.tables import PartKey, task_line

Policy = Literal["sample", "deterministic"]

TASKS_FILE = "tasks.json"
NUMBERS_FILE = "task_numbers.json"
COLUMNS = 4

LARGEST_FILE = 2**22
"""Bytes of one episode's file; those that were published have at most a few hundred kilobytes."""

MOST_OPERATIONS = 2**18
"""Of a pickle; an episode of 500 steps takes 30,000. One of a single byte may take a hundred in memory."""

NUMBER_TYPES = ("b1", "f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
OBJECT_TYPE = "O8"

_HEADER = re.compile(
    rb"\x93NUMPY(?:\x01\x00..|\x02\x00....)"
    rb"\{'descr': '\|O', 'fortran_order': False, 'shape': \((\d{1,9}), 4\), \} *\n",
    re.DOTALL,
)
"""Version, length and text; a pattern, since NumPy's own reader takes the text for Python."""

_TASK = re.compile(r"goal_idx([0-9]{1,9})")
_EPISODE = re.compile(r"trj_eval(sample)?([0-9]{1,9})_step([0-9]{1,9})\.npy")


@final
class IdaqNpyFormat(Format):
    """One folder per task, one file per episode; an episode without steps is a `StoreError`.

    Episodes of several runs at the same snapshot step are numbered on.
    """

    name = "idaq-npy"

    def place(self, selection: Selection, task: Task) -> str:
        return f"goal_idx{_numbered(selection).index(task.index)}"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        with named_errors(path, remedy=REMEDY):
            disk.make_folder(path)
        written: Counter[int] = Counter()
        for key, trajectories in self.parts(selection, task, path):
            for trajectory in trajectories:
                file = path / f"trj_evalsample{written[key.step]}_step{key.step}.npy"
                with named_errors(file, remedy=REMEDY):
                    disk.write(file, _pickled(trajectory))
                written[key.step] += 1
            yield key

    def accompanying(self, selection: Selection) -> Mapping[str, bytes]:
        lines = b",\n".join(task_line(task).strip() for task in selection.tasks)
        numbers = json.dumps(_numbered(selection)).encode()
        return {TASKS_FILE: b"[\n" + lines + b"\n]\n", NUMBERS_FILE: numbers + b"\n"}


def _numbered(selection: Selection) -> list[int]:
    """The indices of the tasks by their numbers in the export: training tasks first."""
    return [
        task.index for task in sorted(selection.tasks, key=lambda task: (task.split == "test", task.index))
    ]


def _pickled(trajectory: Trajectory) -> bytes:
    """The content of an episode's file, which every Python 3 and every NumPy reads."""
    rows = np.empty((len(trajectory), COLUMNS), dtype=object)
    for step, row in enumerate(rows):
        row[0], row[1] = trajectory.observations[step], trajectory.actions[step]
        row[2], row[3] = float(trajectory.rewards[step]), trajectory.observations[step + 1]
    header = BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": rows.shape})
    content = pickle.dumps(rows, protocol=3)
    # NumPy 2 names a module that NumPy 1 lacks, on which the published code runs; both have the other one
    return header.getvalue() + content.replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n", 1)


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
        numbers = [path / NUMBERS_FILE] if (path / NUMBERS_FILE).exists() else []
        return [*numbers, *(file.path for file in self._chosen(path, None))]

    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        indices = _task_indices(path)
        parts: dict[tuple[int, int], list[_File]] = defaultdict(list)
        for file in self._chosen(path, say):
            parts[file.task, file.step].append(file)
        cuts = EpisodeCuts()
        for (task, step), files in parts.items():
            yield ReadPart(
                FileTask(indices(task)),
                step,
                [episode for file in files for episode in _read(file.path, cuts)],
            )
        cuts.tell(say, path)

    def _chosen(self, path: Path, say: Say | None) -> list[_File]:
        """The files to read, sorted by task, step and episode."""
        found = sorted(_list(path))
        sampled = {file.task for file in found if file.policy == "sample"}
        wanted = self.options.episodes
        chosen = [
            file
            for file in found
            if file.policy == (wanted or ("sample" if file.task in sampled else "deterministic"))
        ]
        if not chosen:
            raise StoreError(
                f"{path}: holds no goal_idx0/trj_evalsample0_step0.npy ; name the folder of the tasks"
            )
        if say is not None and len(chosen) < len(found):
            say(f"{path.name}: {len(found) - len(chosen):,} episodes of the other policy are left out")
        return chosen


def _task_indices(path: Path) -> Callable[[int], int]:
    """The index of the task with a number: the number itself, or what an export's `task_numbers.json` says.

    Raises:
        StoreError: the file is no list of indices, or too short.
    """
    file = path / NUMBERS_FILE
    if not file.exists():
        return lambda number: number
    with damage_at(str(file)):
        indices = parse_json(read_plain_file(file, limit=LARGEST_FILE))
        if not isinstance(indices, list) or not all(type(index) is int and index >= 0 for index in indices):
            raise ValueError("is no list of task indices")
        if len(set(indices)) < len(indices):
            raise ValueError("names a task twice")

    def index(number: int) -> int:
        if number >= len(indices):
            raise StoreError(f"{file}: has no task {number}; it lists {len(indices)}")
        return int(indices[number])

    return index


def _list(path: Path) -> Iterator[_File]:
    """All episodes' files below a path.

    Raises:
        StoreError: a folder cannot be listed, or an episode's file is no regular file.
    """
    for task in filter(None, map(_TASK.fullmatch, _names(path))):
        for episode in filter(None, map(_EPISODE.fullmatch, _names(path / task[0]))):
            file = path / task[0] / episode[0]
            require_file(file)
            policy: Policy = "sample" if episode[1] else "deterministic"
            yield _File(int(task[1]), int(episode[3]), int(episode[2]), policy, file)


def _names(folder: Path) -> list[str]:
    with damage_at(f"{printable(str(folder))} cannot be read:"):
        return os.listdir(folder)


def _read(path: Path, cuts: EpisodeCuts) -> list[Trajectory]:
    """The episode of a file; several where its rows do not follow each other."""
    with damage_at(str(path)):
        data = read_plain_file(path, limit=LARGEST_FILE)
        cells = _cells(data)
        observations, actions, rewards, following = (
            _column(cells[column::COLUMNS], column, len(data)) for column in range(COLUMNS)
        )
    rows = {
        "observations": observations,
        "actions": actions,
        "rewards": rewards,
        "next_observations": following,
    }
    return episodes_of_rows(rows, cuts=cuts, place=str(path))


def _cells(data: bytes) -> list[Any]:
    """The cells of all rows of a file, one row's behind another's.

    Raises:
        ValueError: it is no object array of rows; the message does not name the file.
    """
    match = _HEADER.match(data)
    if match is None:
        raise ValueError(f"is no object array of rows of {COLUMNS} cells [observation, action, reward, next]")
    shape = (int(match[1]), COLUMNS)
    array = unpickle_array(data[match.end() :])
    if array.cells is None or array.shape != shape or not shape[0]:
        raise PickleRefusedError(f"says shape {shape} and holds {array.shape}")
    return array.cells


def _column(cells: list[Any], column: int, file_bytes: int) -> npt.NDArray[Any]:
    """A cell of all rows: numbers of (rows,), or arrays of (rows, width)."""
    arrays = [_numbers(cell) for cell in cells]
    if any(array.shape != arrays[0].shape or array.ndim > 1 for array in arrays):
        raise ValueError(f"has cells of different shapes in column {column}")
    if len(arrays) * max(arrays[0].nbytes, 8) > decoded_limit(file_bytes):
        raise ValueError(f"has more values in column {column} than its size justifies")
    return np.stack(arrays)


def _numbers(cell: Any) -> npt.NDArray[Any]:
    if isinstance(cell, PickledArray):
        return cell.numbers()
    if isinstance(cell, int | float):
        return np.asarray(float(cell))
    raise PickleRefusedError(f"has a cell that is {type(cell).__name__}, not a number")


class PickleRefusedError(ValueError):
    """A pickle that holds anything but arrays and numbers; the message does not name the file."""


class _StandIn:
    """What a pickle's name stands for, or its result: a pickle can give it a state, but set no attribute."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise PickleRefusedError("holds a state of something else than an array")


@final
class _Name(_StandIn):
    """A name of the allow-list, and what it does when it is called."""

    __slots__ = ("call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call

    def __call__(self, *arguments: Any) -> Any:
        return self.call(*arguments)


@final
class _Type(_StandIn):
    """`numpy.dtype`: a number of fixed size, or objects."""

    __slots__ = ("code", "order")

    def __init__(self, code: Any, *flags: Any) -> None:
        if code not in (OBJECT_TYPE, *NUMBER_TYPES):
            raise PickleRefusedError(f"holds values of type {repr(code)[:40]}")
        self.code, self.order = code, "<"

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
            raise PickleRefusedError("holds a type whose state is not NumPy's")
        if any(member is not None for member in state[2:5]):
            raise PickleRefusedError("holds a structured type")
        self.order = ">" if state[1] == ">" else "<"

    def values(self, data: Any, count: int) -> npt.NDArray[Any]:
        """Numbers, as a view of their bytes."""
        dtype = np.dtype(f"{self.order}{self.code}")
        if not isinstance(data, bytes) or len(data) != count * dtype.itemsize:
            raise PickleRefusedError(f"holds {count} values without their {count * dtype.itemsize} bytes")
        return np.frombuffer(data, dtype)


@final
class PickledArray(_StandIn):
    """An array as a pickle has it: `numpy.core.multiarray._reconstruct` makes it, its state fills it.

    Attributes:
        shape: of the array.
        cells: for objects, one for each element, in C order.
    """

    __slots__ = ("_values", "cells", "shape")

    def __init__(self, kind: Any, shape: Any, code: Any) -> None:
        if kind is not _ARRAY or shape != (0,):
            raise PickleRefusedError("makes something else than an array")
        self.shape: tuple[int, ...] = ()
        self.cells: list[Any] | None = None
        self._values: npt.NDArray[Any] | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise PickleRefusedError("holds an array whose state is not NumPy's")
        _, shape, kind, is_fortran, data = state
        if not isinstance(shape, tuple) or len(shape) > 2 or not isinstance(kind, _Type):
            raise PickleRefusedError("holds an array without shape or type")
        if not all(type(size) is int and size >= 0 for size in shape):
            raise PickleRefusedError(f"holds an array of shape {repr(shape)[:80]}")
        if is_fortran and len(shape) > 1:
            raise PickleRefusedError("holds an array in Fortran order")
        self.shape, self.cells, self._values = shape, None, None
        if kind.code != OBJECT_TYPE:
            self._values = kind.values(data, prod(shape)).reshape(shape)
        elif isinstance(data, list) and len(data) == prod(shape):
            self.cells = data
        else:
            raise PickleRefusedError(f"holds an object array of shape {shape} without its elements")

    def numbers(self) -> npt.NDArray[Any]:
        """The values, a view of the pickle's bytes.

        Raises:
            PickleRefusedError: the array holds objects, or has no state.
        """
        if self._values is None:
            raise PickleRefusedError("holds objects where numbers should be")
        return self._values


def _refused(*arguments: Any) -> Any:
    raise PickleRefusedError("makes something else than an array")


def _bytes(text: Any, encoding: Any) -> bytes:
    """`_codecs.encode`, by which protocol 2 writes bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise PickleRefusedError("encodes something else than bytes")
    return text.encode("latin1")


def _scalar(kind: Any, data: Any) -> float:
    """`numpy.core.multiarray.scalar`, which makes a number."""
    if not isinstance(kind, _Type) or kind.code == OBJECT_TYPE:
        raise PickleRefusedError("holds a number without its type")
    return float(kind.values(data, 1)[0])


_ARRAY = _Name(_refused)
"""`numpy.ndarray`, which arrays name and never call."""

_ALLOWED: dict[tuple[str, str], _Name] = {
    ("numpy", "ndarray"): _ARRAY,
    ("numpy", "dtype"): _Name(_Type),
    ("_codecs", "encode"): _Name(_bytes),
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Name(PickledArray) for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _Name(_scalar) for core in ("core", "_core")},
}


def _counted(operation: Callable[[Any], None]) -> Callable[[Any], None]:
    def run(unpickler: Any) -> None:
        unpickler.left -= 1
        if unpickler.left < 0:
            raise PickleRefusedError(f"has more than {MOST_OPERATIONS} operations")
        operation(unpickler)

    return run


class _Unpickler(pickle._Unpickler):
    dispatch = {  # noqa: RUF012
        code: _counted(operation) for code, operation in pickle._Unpickler.dispatch.items()
    }
    left = MOST_OPERATIONS

    def find_class(self, module: str, name: str) -> Any:
        found = _ALLOWED.get((module, name))
        if found is None:
            place = printable(f"{module}.{name}")[:80]
            raise PickleRefusedError(f"names {place}, which arrays do not need; it would run code")
        return found


def unpickle_array(data: bytes) -> PickledArray:
    """The array of a pickle.

    Raises:
        PickleRefusedError: the pickle is damaged, or holds anything but arrays and numbers.
    """
    try:
        found = _Unpickler(BytesIO(data)).load()
    except PickleRefusedError:
        raise
    except (*DAMAGE, RecursionError) as error:
        raise PickleRefusedError(f"is no whole pickle ({one_line(error) or type(error).__name__})") from None
    if not isinstance(found, PickledArray):
        raise PickleRefusedError(f"holds {type(found).__name__.strip('_')}, not an array")
    return found
