"""HDF5 files of strangers: numbers and short texts of plain datasets, and nothing else.

Links other than hard ones, and external and virtual storage, are refused before they are followed, since they
may lead to other files. h5py reads the rest. It would unpack a chunk to whatever size it holds, so that
compressed chunks are unpacked here first, up to the size that their dataset declares.
"""

import contextlib
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line, printable
from tcmrl_data.interchange.reader import (
    TASK_ATTRIBUTES,
    FileTask,
    decoded_limit,
    described_task,
    require_file,
)
from tcmrl_data.store.keys import MAX_INDEX

LARGEST_ATTRIBUTE = 2**20

FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
"""All others are either rare or code that is loaded from elsewhere."""

NUMBERS = "biuf"
"""Kinds of the types that are read: truth values, integers, floats."""

_ERRORS = (
    *(OSError, RuntimeError, KeyError, ValueError, TypeError),
    *(AttributeError, OverflowError, MemoryError, SystemError),
)
"""What h5py raises for damaged files."""


class Hdf5File:
    """An opened file; paths are absolute, such as `/episodes/000000/actions`.

    Raises:
        StoreError: it is missing or no HDF5; all methods raise it too, naming file and member.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = require_file(path).stat().st_size
        self._left = self._limit = decoded_limit(self._size)
        with self._named(""):
            self._file = h5py.File(path, "r", locking=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(*_ERRORS):
            self._file.close()

    def members(self, group: str) -> list[str]:
        """Names in a group, sorted."""
        with self._named(group):
            found = self._object(group)
            if not isinstance(found, h5py.Group):
                raise ValueError("is no group")
            return sorted(name for name in found if isinstance(name, str))

    def holds(self, path: str) -> bool:
        """Whether there is a group or dataset at a path."""
        with self._named(path):
            return self._object(path) is not None

    def is_group(self, path: str) -> bool:
        """Whether there is a group at a path."""
        with self._named(path):
            return isinstance(self._object(path), h5py.Group)

    def attribute(self, path: str, name: str) -> Any:
        """A number or text; None where there is no such attribute."""
        with self._named(f"{path} attribute {name}"):
            found = self._object(path)
            if found is None or not h5py.h5a.exists(found.id, name.encode()):
                return None
            opened = h5py.h5a.open(found.id, name.encode())
            if opened.shape != () or opened.get_storage_size() > LARGEST_ATTRIBUTE:
                raise ValueError("is no single value")
            is_text = opened.get_type().get_class() == h5py.h5t.STRING
            if not is_text and opened.dtype.kind not in NUMBERS:
                raise ValueError(f"is of type {opened.dtype}")
            value = found.attrs[name]
            return value.decode() if isinstance(value, bytes) else value if is_text else value.item()

    def index(self, path: str, name: str, default: int | None = None) -> int:
        """An attribute that is a task's index or a snapshot's step; the default where there is none."""
        value = self.attribute(path, name)
        if value is None and default is not None:
            return default
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < MAX_INDEX:
            raise StoreError(f"{self.path}: {path} attribute {name} is {repr(value)[:40]}, not an index")
        return value

    def task(self, *, version: int) -> tuple[int, FileTask]:
        """The task that the attributes of an exported file name."""
        attributes = {name: self.attribute("/", name) for name in TASK_ATTRIBUTES}
        return described_task(attributes, version=version, place=str(self.path))

    def rank(self, path: str) -> int | None:
        """Number of dimensions of a dataset; None where there is none."""
        with self._named(path):
            found = self._object(path)
            return len(found.shape or ()) if isinstance(found, h5py.Dataset) else None

    def array(self, path: str) -> npt.NDArray[Any]:
        """The values of a dataset, in the machine's byte order."""
        with self._named(path):
            found = self._object(path)
            if not isinstance(found, h5py.Dataset):
                raise ValueError("is missing" if found is None else "is no dataset")
            if found.dtype.kind not in NUMBERS or found.dtype.itemsize > 8 or found.dtype.subdtype:
                raise ValueError(f"is of type {found.dtype}, not of numbers")
            if found.shape is None:
                raise ValueError("has no shape")
            if found.is_virtual or found.external:
                raise ValueError("has its values in other files or datasets")
            self._left -= found.nbytes
            if self._left < 0:
                raise ValueError(
                    f"would take the values read beyond {self._limit} bytes, which the file's size does not "
                    "justify; if you trust the file, write it again without compression (`h5repack -f NONE`)"
                )
            self._check_chunks(found)
            values = np.asarray(found[()])
            return values.astype(values.dtype.newbyteorder("="), copy=False)

    def columns(self, group: str, keys: Sequence[str]) -> npt.NDArray[Any]:
        """Datasets of a group side by side, as (rows, columns); those of rank 1 are one column."""
        members = [self.array(f"{group}/{key}") for key in keys]
        members = [member[:, None] if member.ndim == 1 else member for member in members]
        if not members or any(member.ndim != 2 or len(member) != len(members[0]) for member in members):
            raise StoreError(
                f"{self.path}: {group} holds no rows of equal number; choose its members by --option "
                "observation_keys=A,B"
            )
        return np.concatenate(members, axis=1)

    def _object(self, path: str) -> Any:
        """The group or dataset at a path, reached through hard links alone; None where there is none."""
        found: Any = self._file
        for name in filter(None, path.split("/")):
            # `name in found` would follow the link, into another file too
            if not isinstance(found, h5py.Group) or not found.id.links.exists(name.encode()):
                return None
            if found.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
                raise ValueError("is reached through a soft or external link, which is not followed")
            found = found[name]
        return found

    def _check_chunks(self, found: Any) -> None:
        """Refuses chunks that are larger than they say, or than the file justifies."""
        if found.chunks is None:
            return
        properties = found.id.get_create_plist()
        filters = [properties.get_filter(index)[0] for index in range(properties.get_nfilters())]
        if set(filters) - FILTERS or len(set(filters)) < len(filters):
            raise ValueError(f"has filters {filters}; only gzip, shuffle and fletcher32 are read")
        chunk_bytes = int(np.prod(found.chunks, dtype=object)) * found.dtype.itemsize
        if chunk_bytes > self._limit:
            raise ValueError(f"has chunks of {chunk_bytes} bytes, which the file's size does not justify")
        is_packed = h5py.h5z.FILTER_DEFLATE in filters
        packed_bit = 1 << filters.index(h5py.h5z.FILTER_DEFLATE) if is_packed else 0

        def check(chunk: Any) -> None:
            if chunk.size > self._size:
                raise ValueError("has a chunk that is larger than the file")
            if packed_bit and not chunk.filter_mask & packed_bit:
                _, packed = found.id.read_direct_chunk(chunk.chunk_offset)
                if len(zlib.decompressobj().decompress(packed, chunk_bytes + 1)) > chunk_bytes:
                    raise ValueError("has a chunk that unpacks to more than it should")

        found.id.chunk_iter(check)

    @contextlib.contextmanager
    def _named(self, member: str) -> Iterator[None]:
        """Turns what h5py raises into an error that names the file and the member."""
        try:
            yield
        except StoreError:
            raise
        except (*_ERRORS, zlib.error) as error:
            reason = one_line(error) or type(error).__name__
            if not member:
                raise StoreError(f"{self.path} does not open as HDF5 ({reason})") from None
            raise StoreError(f"{self.path}: {printable(member)[:200]} {reason}") from None
