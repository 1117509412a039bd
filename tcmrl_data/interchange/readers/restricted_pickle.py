"""Object arrays of NumPy from strangers' pickles, without running what a pickle can run.

The interpreter knows the operations that NumPy's arrays need and no others, and the names of NumPy's
reconstructors and no others. The names stand for stubs of this module, so that not even NumPy's own
reconstructors run: a stub compares shape and type with the bytes that are there before it makes an array.
"""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from math import prod
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.plain_files import one_line, printable

_OPERATIONS = (
    *(pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE),
    *(pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.BINFLOAT),
    *(pickle.BINUNICODE, pickle.SHORT_BINUNICODE, pickle.BINBYTES, pickle.SHORT_BINBYTES),
    *(pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3, pickle.EMPTY_TUPLE, pickle.EMPTY_LIST),
    *(
        pickle.APPEND,
        pickle.APPENDS,
        pickle.POP,
        pickle.GLOBAL,
        pickle.STACK_GLOBAL,
        pickle.REDUCE,
        pickle.BUILD,
    ),
    *(pickle.MEMOIZE, pickle.BINPUT, pickle.LONG_BINPUT, pickle.BINGET, pickle.LONG_BINGET),
)
_TYPES = ("O8", "b1", "f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
_MOST_DIMENSIONS = 8
_STATE_LENGTHS = range(5, 10)


class PickleRefusedError(ValueError):
    """A pickle that holds anything but arrays and numbers; the message does not name the file."""


@final
class _Type:
    """`numpy.dtype`: a number of fixed size, or objects."""

    __slots__ = ("code", "order")

    def __init__(self, code: Any, *flags: Any) -> None:
        if code not in _TYPES:
            raise PickleRefusedError(f"holds values of type {repr(code)[:40]}")
        self.code, self.order = str(code), "<"

    def __setstate__(self, state: Any) -> None:
        if (
            not isinstance(state, tuple)
            or len(state) not in _STATE_LENGTHS
            or state[1] not in ("<", ">", "|", "=")
        ):
            raise PickleRefusedError("holds a type whose state is not NumPy's")
        if any(member is not None for member in state[2:5]):
            raise PickleRefusedError("holds a structured type")
        self.order = ">" if state[1] == ">" else "<"

    @property
    def is_object(self) -> bool:
        return self.code == "O8"

    def dtype(self) -> np.dtype[Any]:
        return np.dtype(f"{self.order}{self.code}")


@final
class PickledArray:
    """An array as the pickle has it.

    Attributes:
        shape: of the array.
        cells: for objects, one for each element, in C order.
    """

    __slots__ = ("_data", "_type", "cells", "shape")

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = ()
        self.cells: Sequence[Any] | None = None
        self._data = b""
        self._type: _Type | None = None

    def __setstate__(self, state: Any) -> None:
        if self._type is not None or not isinstance(state, tuple) or len(state) != 5:
            raise PickleRefusedError("holds an array whose state is not NumPy's")
        _, shape, kind, is_fortran, data = state
        if not isinstance(shape, tuple) or len(shape) > _MOST_DIMENSIONS or not isinstance(kind, _Type):
            raise PickleRefusedError("holds an array without shape or type")
        if not all(type(size) is int and size >= 0 for size in shape):
            raise PickleRefusedError(f"holds an array of shape {repr(shape)[:80]}")
        if is_fortran and len(shape) > 1:
            raise PickleRefusedError("holds an array in Fortran order")
        size = prod(shape)
        if kind.is_object:
            if not isinstance(data, list) or len(data) != size:
                raise PickleRefusedError(
                    f"holds an object array of shape {repr(shape)[:80]} without its elements"
                )
            self.cells = data
        else:
            needed = size * kind.dtype().itemsize
            if not isinstance(data, bytes) or len(data) != needed:
                raise PickleRefusedError(
                    f"holds an array of shape {repr(shape)[:80]} without its {needed} bytes"
                )
            self._data = data
        self.shape, self._type = shape, kind

    def numbers(self) -> npt.NDArray[Any]:
        """The values, a view of the pickle's bytes.

        Raises:
            PickleRefusedError: the array holds objects, or has no state.
        """
        if self._type is None or self._type.is_object:
            raise PickleRefusedError("holds objects where numbers should be")
        return np.frombuffer(self._data, dtype=self._type.dtype()).reshape(self.shape)


@dataclass(frozen=True)
class _Name:
    """A class that is named and never called."""

    name: str


_NDARRAY = _Name("ndarray")


def _reconstruct(kind: Any, shape: Any, code: Any) -> PickledArray:
    if kind is not _NDARRAY or shape != (0,):
        raise PickleRefusedError("makes something else than an array")
    return PickledArray()


def _scalar(kind: Any, data: Any) -> float:
    if not isinstance(kind, _Type) or kind.is_object or not isinstance(data, bytes):
        raise PickleRefusedError("holds a number without its bytes")
    dtype = kind.dtype()
    if len(data) != dtype.itemsize:
        raise PickleRefusedError("holds a number without its bytes")
    return float(np.frombuffer(data, dtype=dtype)[0])


def _encode(text: Any, encoding: Any) -> bytes:
    """`_codecs.encode`, by which protocol 2 writes bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise PickleRefusedError("encodes something else than bytes")
    return text.encode("latin1")


_NAMES = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Type,
    ("_codecs", "encode"): _encode,
} | {
    (f"numpy.{core}.multiarray", name): stub
    for core in ("core", "_core")
    for name, stub in (("_reconstruct", _reconstruct), ("scalar", _scalar))
}


MOST_OPERATIONS = 2**18
"""Of a pickle; an episode of 500 steps takes 30,000. One of a single byte may take a hundred in memory."""


def _counted(operation: Any) -> Any:
    def run(unpickler: Any) -> None:
        unpickler.left -= 1
        if unpickler.left < 0:
            raise PickleRefusedError(f"has more than {MOST_OPERATIONS} operations")
        operation(unpickler)

    return run


class _Unpickler(pickle._Unpickler):
    """The interpreter written in Python: unlike the one in C, it allocates nothing on a pickle's word."""

    dispatch = {  # noqa: RUF012
        operation[0]: _counted(pickle._Unpickler.dispatch[operation[0]]) for operation in _OPERATIONS
    }

    left = MOST_OPERATIONS

    def find_class(self, module: str, name: str) -> Any:
        found = _NAMES.get((module, name))
        if found is None:
            place = printable(f"{module}.{name}")[:80]
            raise PickleRefusedError(f"names {place}, which arrays do not need; it would run code")
        return found

    def persistent_load(self, pid: Any) -> Any:
        raise PickleRefusedError("refers to objects outside")


def unpickle_array(data: bytes) -> PickledArray:
    """The array of a pickle.

    Raises:
        PickleRefusedError: the pickle is damaged, or holds anything but arrays and numbers.
    """
    try:
        found = _Unpickler(BytesIO(data)).load()
    except PickleRefusedError:
        raise
    except KeyError as error:
        code = error.args[0] if error.args else None
        operation = f"operation {bytes([code])!r}" if isinstance(code, int) else "a reference to nothing"
        raise PickleRefusedError(f"has {operation}, which arrays do not need") from None
    except (
        *(EOFError, pickle.UnpicklingError, ValueError, TypeError, IndexError, AttributeError),
        *(OverflowError, MemoryError, RecursionError),
    ) as error:
        raise PickleRefusedError(f"is no whole pickle ({one_line(error) or type(error).__name__})") from None
    if not isinstance(found, PickledArray):
        raise PickleRefusedError(f"holds {type(found).__name__.strip('_')}, not an array")
    return found
