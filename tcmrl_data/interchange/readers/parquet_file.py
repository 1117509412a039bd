"""Parquet files of strangers: plain columns of numbers and of lists of numbers, and nothing else.

The footer and the headers of all pages are read here first. A page that unpacks to more than it should, a
number of values that the file's size does not justify, other files' columns, encryption and rare codecs are
refused before pyarrow sees the file: it would allocate what a header says.
"""

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line, printable
from tcmrl_data.interchange.readers.source_files import decoded_limit, require_file
from tcmrl_data.interchange.readers.thrift import CompactReader, Fields

MAGIC = b"PAR1"
LARGEST_FOOTER = 2**22
LARGEST_PAGE_HEADER = 2**16
MOST_COLUMNS = 2**8
MOST_ROW_GROUPS = 2**12
BATCH_ROWS, BATCH_VALUES = 2**12, 2**18

ITEM_BYTES = {0: 1, 1: 4, 2: 8, 4: 4, 5: 8}
"""Bytes of a decoded value by Parquet's number of its type: boolean, int32, int64, float, double."""

CODECS = {0: "none", 1: "snappy", 2: "gzip", 6: "zstd"}
ENCODINGS = {0: "plain", 2: "plain dictionary", 3: "run length", 8: "dictionary", 9: "byte stream split"}
DATA_PAGE, DICTIONARY_PAGE, DATA_PAGE_2 = 0, 2, 3
PAGE_FIELDS = {DATA_PAGE: 5, DICTIONARY_PAGE: 7, DATA_PAGE_2: 8}
"""Kinds of pages, and the field of their header that describes them."""

_ERRORS = (
    OSError,
    RuntimeError,
    ValueError,
    TypeError,
    LookupError,
    OverflowError,
    MemoryError,
    AttributeError,
)
"""What pyarrow raises for damaged files, and what stems from records that lack a field."""


@final
class ParquetFile:
    """A file whose footer is checked; `batches` checks the columns that it reads.

    Args:
        path: the file.

    Attributes:
        names: of the columns that are numbers, or lists of numbers.

    Raises:
        StoreError: it is missing or no Parquet; all methods raise it too, naming the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = require_file(path).stat().st_size
        self._values_left = self._pages_left = decoded_limit(self._size)
        with self._named(" does not open as Parquet"):
            self._footer = self._read_footer()
            self._check_row_groups()
            self.names = [name for name, leaf in _leaves(self._footer[2]).items() if leaf in ITEM_BYTES]

    def text(self, key: str) -> str | None:
        """A value of the file's metadata; None where there is none."""
        with self._named(f": metadata {key}"):
            pairs = {pair[1]: pair.get(2, b"") for pair in self._footer.get(5, [])}
            found = pairs.get(key.encode())
            return None if found is None else str(found.decode())

    def batches(self, names: Sequence[str]) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
        """The rows, some thousands at a time, by column: (rows,), or (rows, width) for lists."""
        with self._named(""):
            widths = self._check_columns(names)
            opened = self._open()
            for name in names:
                _check_type(opened.schema_arrow.field(name).type, widths[name])
            rows = max(1, min(BATCH_ROWS, BATCH_VALUES // max(widths.values())))
            found = opened.iter_batches(batch_size=rows, columns=list(names), use_threads=False)
            while (batch := next(found, None)) is not None:
                yield {name: _numbers(batch.column(name), widths[name], name) for name in names}

    def _open(self) -> Any:
        from pyarrow import parquet

        return parquet.ParquetFile(
            self.path,
            buffer_size=2**16,
            pre_buffer=False,
            thrift_string_size_limit=LARGEST_FOOTER,
            thrift_container_size_limit=MOST_ROW_GROUPS,
        )

    def _read_footer(self) -> Fields:
        ends = 2 * len(MAGIC) + 4
        with self.path.open("rb") as file:
            tail = os.pread(file.fileno(), 4 + len(MAGIC), max(0, self._size - 4 - len(MAGIC)))
            length = int.from_bytes(tail[:4], "little")
            if (
                self._size < ends
                or not tail.endswith(MAGIC)
                or length > min(self._size - ends, LARGEST_FOOTER)
            ):
                raise ValueError("no footer, or a longer one than the file")
            self._data_end = self._size - 4 - len(MAGIC) - length
            return CompactReader(os.pread(file.fileno(), length, self._data_end)).record()

    def _check_row_groups(self) -> None:
        schema, groups = self._footer[2], self._footer[4]
        if not 0 < len(schema) <= MOST_COLUMNS or len(groups) > MOST_ROW_GROUPS:
            raise ValueError(f"has {len(schema)} columns and {len(groups)} row groups, too many or none")
        if sum(group[3] for group in groups) != self._footer[3] or any(group[3] < 0 for group in groups):
            raise ValueError("its row groups do not have the rows that it names")

    def _check_columns(self, names: Sequence[str]) -> dict[str, int]:
        """The width of every column, 1 for one of numbers; refuses chunks that claim too much."""
        widths: dict[str, int] = {}
        with self.path.open("rb") as file:
            for group in self._footer[4]:
                chunks = {chunk[3][3][0].decode(): chunk for chunk in group[1]}
                for name in names:
                    values = self._check_chunk(file.fileno(), name, chunks[name])
                    rows = group[3]
                    width = values // rows if rows else widths.get(name, 1)
                    if rows * width != values or widths.setdefault(name, width) != width or width < 1:
                        raise ValueError(f"{name} has {values} values in {rows} rows")
        return {name: widths.get(name, 1) for name in names}

    def _check_chunk(self, file: int, name: str, chunk: Fields) -> int:
        """The number of values of a column chunk, which its pages must justify."""
        if 1 in chunk or 8 in chunk or 9 in chunk:
            raise ValueError(f"{name} lies in another file or is encrypted")
        meta = chunk[3]
        codec, values, size = meta[4], meta[5], meta[7]
        if meta[1] not in ITEM_BYTES:
            raise ValueError(f"{name} is of two types")
        if codec not in CODECS:
            raise ValueError(f"{name} has codec {codec}; only {', '.join(CODECS.values())} are read")
        self._values_left -= max(0, values) * ITEM_BYTES[meta[1]]
        if values < 0 or self._values_left < 0:
            raise ValueError(
                f"{name} has more values than the file's size justifies; if you trust the file, write it "
                "again without compression"
            )
        start = min(meta[9], meta.get(11) or meta[9])
        if not len(MAGIC) <= start <= start + size <= self._data_end:
            raise ValueError(f"{name} lies outside the file")
        if self._values_of_pages(file, name, start, start + size, codec) != values:
            raise ValueError(f"{name} does not have the values that it names")
        return int(values)

    def _values_of_pages(self, file: int, name: str, start: int, end: int, codec: int) -> int:
        """Walks over the pages of a chunk by their headers; the number of values in its data pages."""
        found = 0
        while start < end:
            header, start = _page_header(file, start, end)
            unpacked, packed = header[2], header[3]
            self._pages_left -= max(0, unpacked)
            if min(unpacked, packed) < 0 or packed > end - start or self._pages_left < 0:
                raise ValueError(f"{name} has a page that is larger than the file justifies")
            if codec == 0 and packed != unpacked:
                raise ValueError(f"{name} has an uncompressed page of two sizes")
            if header[1] not in PAGE_FIELDS:
                raise ValueError(f"{name} has a page of unknown kind {header[1]}")
            inner = header[PAGE_FIELDS[header[1]]]
            if inner[4 if header[1] == DATA_PAGE_2 else 2] not in ENCODINGS:
                raise ValueError(f"{name} has an encoding other than {', '.join(ENCODINGS.values())}")
            if inner[1] < 0 or (header[1] == DICTIONARY_PAGE and inner[1] > 8 * unpacked):
                raise ValueError(f"{name} has a page with more values than bytes")
            found += inner[1] if header[1] != DICTIONARY_PAGE else 0
            start += packed
        return found

    @contextlib.contextmanager
    def _named(self, what: str) -> Iterator[None]:
        """Turns what damaged files cause into an error that names the file."""
        try:
            yield
        except StoreError:
            raise
        except _ERRORS as error:
            reason = printable(one_line(error))[:300] or type(error).__name__
            raise StoreError(f"{self.path}{what}: {reason}") from None


def _leaves(schema: Sequence[Fields]) -> dict[str, int]:
    """Types of the columns that are flat, or lists of one flat column; by the columns' names."""
    leaves: dict[str, int] = {}
    position = 1
    for _ in range(schema[0].get(5, 0)):
        name = schema[position][4].decode()
        depth = 0
        while schema[position].get(5, 0) == 1 and depth < 2:
            position, depth = position + 1, depth + 1
        children = schema[position].get(5, 0)
        if children:
            raise ValueError(f"column {name} is a record; only numbers and lists of numbers are read")
        if depth in (0, 2):
            leaves[name] = schema[position].get(1, -1)
        position += 1
    return leaves


def _page_header(file: int, start: int, end: int) -> tuple[Fields, int]:
    """The header of a page, and where the page's content starts."""
    for size in (2**9, LARGEST_PAGE_HEADER):
        reader = CompactReader(os.pread(file, min(size, end - start), start))
        with contextlib.suppress(ValueError):
            return reader.record(), start + reader.position
    raise ValueError("has a page without a header")


def _check_type(kind: Any, width: int) -> None:
    """Refuses what Arrow's own schema, which a file may hold too, would turn numbers into."""
    from pyarrow import types

    is_list = types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
    item = kind.value_type if is_list else kind
    if not (types.is_integer(item) or types.is_floating(item) or types.is_boolean(item)):
        raise ValueError(f"holds {one_line(ValueError(str(kind)))[:80]}, not numbers")
    if types.is_fixed_size_list(kind) and kind.list_size != width:
        raise ValueError(f"says lists of {kind.list_size} and holds lists of {width}")


def _numbers(column: Any, width: int, name: str) -> npt.NDArray[Any]:
    from pyarrow import types

    is_list = not types.is_primitive(column.type)
    values = column.flatten() if is_list else column
    if column.null_count or values.null_count:
        raise ValueError(f"{name} lacks values")
    if is_list and len(values) != width * len(column):
        raise ValueError(f"{name} has lists of different lengths")
    found = np.asarray(values.to_numpy(zero_copy_only=False))
    return found.reshape(len(column), width) if is_list else found
