"""An episode as NumPy pickles an object array of rows [observation, action, reward, next observation].

NumPy 2 would name modules in the pickle that NumPy 1 lacks, on which the published code runs. So the pickle
is put together here: it names `numpy.core.multiarray`, which both have, and is of protocol 3, which every
Python 3 reads. All rows consist of the same operations around other bytes, so that one array operation writes
them all.
"""

import pickle
import struct
from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory

COLUMNS = 4
FLOAT32 = np.dtype("<f4")

_RECONSTRUCT, _ARGUMENTS, _FLOATS, _OBSERVATION, _ACTION = (bytes([slot]) for slot in range(5))
"""Slots of the pickle's memo: NumPy's function, its arguments, the type float32, and two shapes."""

_GLOBAL = pickle.GLOBAL + b"%b\n%b\n"


def pickled_rows(trajectory: Trajectory) -> bytes:
    """The content of an episode's `.npy` file.

    Args:
        trajectory: with at least one step.
    """
    header, shape = BytesIO(), (len(trajectory), COLUMNS)
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": shape})
    widths = (trajectory.observations.shape[1], trajectory.actions.shape[1])
    return b"".join(
        [
            header.getvalue(),
            pickle.PROTO + b"\x03",
            _memo(*widths),
            _array_start(_integer(shape[0]) + _integer(shape[1]) + pickle.TUPLE2, _type(b"O8", b"|", 63)),
            pickle.EMPTY_LIST + pickle.MARK,
            _cells(trajectory),
            pickle.APPENDS + _ARRAY_END + pickle.STOP,
        ]
    )


def _cells(trajectory: Trajectory) -> bytes:
    """The cells of all rows, one row's behind another's."""
    steps = len(trajectory)
    start = {slot: _array_start(_get(slot), _get(_FLOATS)) for slot in (_OBSERVATION, _ACTION)}
    columns = [
        *_array(start[_OBSERVATION], trajectory.observations[:-1]),
        *_array(start[_ACTION], trajectory.actions),
        _repeated(pickle.BINFLOAT, steps),
        _bytes_of(trajectory.rewards[:, None].astype(">f8")),
        *_array(start[_OBSERVATION], trajectory.observations[1:]),
    ]
    return np.hstack(columns).tobytes()


def _array(start: bytes, rows: npt.NDArray[np.float32]) -> list[npt.NDArray[np.uint8]]:
    """The columns of bytes that pickle an array in every row."""
    content = _bytes_of(rows.astype(FLOAT32))
    length = pickle.BINBYTES + struct.pack("<I", content.shape[1])
    return [_repeated(start + length, len(rows)), content, _repeated(_ARRAY_END, len(rows))]


def _memo(observation_dim: int, action_dim: int) -> bytes:
    """Puts into the memo what arrays refer to, and leaves the stack empty."""
    empty = _integer(0) + pickle.TUPLE1 + pickle.SHORT_BINBYTES + b"\x01b"
    values = {
        _RECONSTRUCT: _GLOBAL % (b"numpy.core.multiarray", b"_reconstruct"),
        _ARGUMENTS: _GLOBAL % (b"numpy", b"ndarray") + empty + pickle.TUPLE3,
        _FLOATS: _type(b"f4", b"<", 0),
        _OBSERVATION: _integer(observation_dim) + pickle.TUPLE1,
        _ACTION: _integer(action_dim) + pickle.TUPLE1,
    }
    return b"".join(value + pickle.BINPUT + slot + pickle.POP for slot, value in values.items())


def _array_start(shape: bytes, kind: bytes) -> bytes:
    """An array of a pickled shape and type, up to its content."""
    made = _get(_RECONSTRUCT) + _get(_ARGUMENTS) + pickle.REDUCE
    return made + pickle.MARK + _integer(1) + shape + kind + pickle.NEWFALSE


_ARRAY_END = pickle.TUPLE + pickle.BUILD


def _type(code: bytes, order: bytes, flags: int) -> bytes:
    """A type as NumPy pickles it: code, byte order and flags."""
    made = _GLOBAL % (b"numpy", b"dtype") + _text(code) + pickle.NEWFALSE + pickle.NEWTRUE + pickle.TUPLE3
    state = _integer(3) + _text(order) + pickle.NONE * 3 + _integer(-1) * 2 + _integer(flags)
    return made + pickle.REDUCE + pickle.MARK + state + pickle.TUPLE + pickle.BUILD


def _get(slot: bytes) -> bytes:
    return pickle.BINGET + slot


def _integer(value: int) -> bytes:
    return pickle.BININT + struct.pack("<i", value)


def _text(value: bytes) -> bytes:
    return pickle.BINUNICODE + struct.pack("<I", len(value)) + value


def _repeated(value: bytes, rows: int) -> npt.NDArray[np.uint8]:
    """The same bytes in every row."""
    return np.tile(np.frombuffer(value, np.uint8), (rows, 1))


def _bytes_of(array: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """The bytes of every row of an array of (rows, columns)."""
    return np.ascontiguousarray(array).view(np.uint8)
