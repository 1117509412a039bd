"""The table of a cache entry: written part by part, with a sha256 per part, and checked in parallel."""

import hashlib
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from tcmrl_data.foundation.disk import disk
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.plain_files import one_line
from tcmrl_data.sampling.rows import READERS, Indices, PartRows, Table, map_parts, read_part

READ_BYTES = 2**22
"""Size of the pieces in which a table is read for hashing."""

BLOCK = np.dtype([("end", "<i8"), ("sha256", "u1", 32)])
"""A part's rows in the file: position of the byte behind them, and their sha256."""

Blocks = npt.NDArray[np.void]


class TableSeal(BaseModel):
    """What the system says of a finished table; while it says the same, no program changed the file.

    Attributes:
        size: bytes.
        inode: number of the file.
        changed: time of the last change in nanoseconds (ctime), which a program cannot set back.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int
    inode: int
    changed: int

    @classmethod
    def of(cls, file: Path) -> "TableSeal":
        """The seal of a file as it lies on disk.

        Raises:
            OSError: the file is missing or cannot be reached.
        """
        status = file.stat()
        return cls(size=status.st_size, inode=status.st_ino, changed=status.st_ctime_ns)


def write_table(file: Path, plan: Sequence[PartRows], shape: tuple[int, int]) -> tuple[list[Indices], Blocks]:
    """Decodes parts into an existing file, so that only the parts being read are in memory.

    Args:
        file: at least as long as the table, and empty (zeros).
        plan: the parts.
        shape: (rows, floats per row) of the table.

    Returns:
        Per part, the lengths of its episodes, and the block of its rows.

    Raises:
        OSError: the operating system refuses to write.
        StoreError: a part's arrays are not those of its record, or do not form episodes.
    """
    row_bytes = 4 * shape[1]
    with file.open("r+b", buffering=0) as out:

        def write(part: PartRows) -> tuple[Indices, bytes]:
            rows: Table = np.zeros((part.last - part.first, shape[1]), dtype=np.float32)
            lengths = read_part(part, rows, check_digests=True)
            data = memoryview(rows.data).cast("B")
            _write_at(out.fileno(), data, row_bytes * part.first)
            return lengths, hashlib.sha256(data).digest()

        written = list(map_parts(plan, write))
        out.truncate(row_bytes * shape[0])
    disk.sync(file)
    blocks = np.empty(len(plan), dtype=BLOCK)
    blocks["end"] = [row_bytes * part.last for part in plan]
    blocks["sha256"] = [np.frombuffer(sha256, dtype=np.uint8) for _, sha256 in written]
    return [lengths for lengths, _ in written], blocks


def _write_at(descriptor: int, data: memoryview, offset: int) -> None:
    while data:
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written


def table_problem(file: Path, blocks: Blocks) -> str | None:
    """Why a file is not the table that was sealed, in words; None if it is. Reads all of it.

    Args:
        file: the table; behind the last block it holds zeros.
        blocks: its blocks, in order.
    """
    try:
        with file.open("rb", buffering=0) as table:
            descriptor, size = table.fileno(), os.fstat(table.fileno()).st_size
            ends = [0, *map(int, blocks["end"])]
            with ThreadPoolExecutor(min(READERS, available_cores())) as pool:
                hashed = pool.map(lambda span: _hash(descriptor, *span), pairwise(ends))
                for (start, end), found, block in zip(pairwise(ends), hashed, blocks, strict=True):
                    if found != block["sha256"].tobytes():
                        return f"bytes {start} to {end} of {file.name} are not those that were written"
            if any(data.count(0) < len(data) for data in _pieces(descriptor, ends[-1], size)):
                return f"{file.name} holds more than zeros behind byte {ends[-1]}"
    except OSError as error:
        return f"{file.name} cannot be read ({one_line(error)})"
    return None


def _hash(descriptor: int, start: int, end: int) -> bytes:
    sha256 = hashlib.sha256()
    for data in _pieces(descriptor, start, end):
        sha256.update(data)
    return sha256.digest()


def _pieces(descriptor: int, start: int, end: int) -> Iterator[bytes]:
    """The bytes of a span of a file, piece by piece; fewer where the file ends before."""
    while start < end and (data := os.pread(descriptor, min(READ_BYTES, end - start), start)):
        yield data
        start += len(data)
