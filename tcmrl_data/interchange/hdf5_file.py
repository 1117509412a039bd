"""HDF5 files: how small arrays are written, and how the files of strangers are read.

Numbers and short texts of plain datasets are read, and nothing else.

Links other than hard ones, and external and virtual storage, are refused before they are followed, since they
may lead to other files. h5py reads the rest. It would unpack a chunk to whatever size it holds, so that
compressed chunks are unpacked here first, up to the size that their dataset declares.
"""

import contextlib
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.files import printable
from tcmrl_data.interchange.reader import (
    DAMAGE,
    TASK_ATTRIBUTES,
    FileTask,
    checked_index,
    damage_at,
    decoded_limit,
    described_task,
    require_file,
)

LARGEST_ATTRIBUTE = 2**20

FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
"""All others are either rare or code that is loaded from elsewhere."""

NUMBERS = "biuf"
"""Kinds of the types that are read: truth values, integers, floats."""


SMALLEST_PACKED = 2**10
"""Bytes of an array from which on gzip is worth its time."""


def new_file(path: Path, mode: str) -> h5py.File:
    """A new file, whose records are short, as HDF5 1.10 and later write and read them."""
    return h5py.File(path, mode, libver=("v110", "v110"))


def write_array(group: h5py.Group, name: str, array: npt.NDArray[Any]) -> None:
    """Writes an array in one piece, compressed where it is not small."""
    if array.nbytes < SMALLEST_PACKED:
        group.create_dataset(name, data=array)
    else:
        group.create_dataset(
            name, data=array, chunks=array.shape, compression="gzip", compression_opts=1, shuffle=True
        )


class Hdf5File(contextlib.AbstractContextManager["Hdf5File"]):
    """An opened file; paths are absolute, such as `/episodes/000000/actions`.

    Raises:
        StoreError: it is missing or no HDF5; all methods raise it too, naming file and member.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = require_file(path).stat().st_size
        self._left = self._limit = decoded_limit(self._size)
        with damage_at(f"{path} does not open as HDF5:"):
            self._file = h5py.File(path, "r", locking=False)

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(*DAMAGE):
            self._file.close()

    def members(self, group: str) -> list[str]:
        """Names in a group, sorted; none where there is no group."""
        with self._at(group):
            found = self._object(group)
            names = found if isinstance(found, h5py.Group) else ()
            return sorted(name for name in names if isinstance(name, str))

    def numbered(self, group: str, prefix: str) -> list[str]:
        """Names in a group that are a prefix and a number, such as `demo_7`, sorted by it."""
        pattern = re.compile(rf"{prefix}([0-9]{{1,9}})")
        matches = map(pattern.fullmatch, self.members(group))
        return [match[0] for match in sorted(filter(None, matches), key=lambda match: int(match[1]))]

    def rank(self, path: str) -> int | None:
        """Number of dimensions of a dataset; None where there is none."""
        with self._at(path):
            found = self._object(path)
            return len(found.shape or ()) if isinstance(found, h5py.Dataset) else None

    def attribute(self, path: str, name: str) -> Any:
        """A number or text; None where there is no such attribute."""
        with self._at(f"{path} attribute {name}"):
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

    def step(self, path: str, name: str) -> int:
        """An attribute that is a snapshot's step; 0 where there is none."""
        value = self.attribute(path, name)
        return 0 if value is None else checked_index(value, f"{self.path}: {path} attribute {name}")

    def task(self) -> FileTask:
        """The task that the attributes of an exported file name."""
        return described_task(
            {name: self.attribute("/", name) for name in TASK_ATTRIBUTES}, place=str(self.path)
        )

    def array(self, path: str) -> npt.NDArray[Any]:
        """The values of a dataset, in the machine's byte order."""
        with self._at(path):
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
            if found.chunks is not None:
                self._check_chunks(found)
            values = np.asarray(found[()])
            return values.astype(values.dtype.newbyteorder("="), copy=False)

    def columns(self, path: str, keys: Sequence[str] | None) -> npt.NDArray[Any]:
        """A dataset, or datasets of a group side by side, as (rows, columns); those of rank 1 are one column.

        Args:
            path: of the dataset or of the group.
            keys: names in the group; all where None.
        """
        names = self.members(path)
        if not names:
            return self.array(path)
        found = [self.array(f"{path}/{name}") for name in keys or names]
        found = [array[:, None] if array.ndim == 1 else array for array in found]
        if any(array.ndim != 2 or len(array) != len(found[0]) for array in found):
            raise StoreError(
                f"{self.path}: {path} holds no rows of equal number; choose its members by --option "
                "observation_keys=A,B"
            )
        return np.concatenate(found, axis=1)

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

    def _check_chunks(self, found: h5py.Dataset) -> None:
        """Refuses chunks that are larger than they say, or than the file justifies."""
        properties = found.id.get_create_plist()
        filters = [properties.get_filter(index)[0] for index in range(properties.get_nfilters())]
        if set(filters) - FILTERS or len(set(filters)) < len(filters):
            raise ValueError(f"has filters {filters}; only gzip, shuffle and fletcher32 are read")
        chunk_bytes = int(np.prod(found.chunks, dtype=object)) * found.dtype.itemsize
        if chunk_bytes > self._limit:
            raise ValueError(f"has chunks of {chunk_bytes} bytes, which the file's size does not justify")
        is_packed = h5py.h5z.FILTER_DEFLATE in filters
        unpacked_bit = 1 << filters.index(h5py.h5z.FILTER_DEFLATE) if is_packed else 0

        def check(chunk: Any) -> None:
            if chunk.size > self._size:
                raise ValueError("has a chunk that is larger than the file")
            if is_packed and not chunk.filter_mask & unpacked_bit:
                _, packed = found.id.read_direct_chunk(chunk.chunk_offset)
                if len(zlib.decompressobj().decompress(packed, chunk_bytes + 1)) > chunk_bytes:
                    raise ValueError("has a chunk that unpacks to more than it should")

        found.id.chunk_iter(check)

    def _at(self, member: str) -> contextlib.AbstractContextManager[None]:
        return damage_at(f"{self.path}: {printable(member)[:200]}")
