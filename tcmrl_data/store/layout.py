"""What the Zarr files of a part may look like: an allow-list, checked before zarr opens anything.

Nothing is decoded that the size on disk does not justify: arrays may decode to 64 MiB, or to 256 times
their files where that is more (real parts: at most about 12 times, since sampled actions do not compress).
"""

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tcmrl_data.foundation.canonical import canonical_json, parse_json
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line
from tcmrl_data.store.archive import Archive

METADATA_BYTES = 2**16
MAX_CHUNKS = 10**4
"""Chunks of one array; in chunks of 16 MB they hold more than an archive may."""

ARRAYS = "arrays"
"""The Zarr group in a part's archive; the part's other files lie beside it."""

DECODED_FLOOR = 64 * 2**20
DECODED_RATIO = 256
ITEM_BYTES = {"float32": 4, "int64": 8, "bool": 1}
FILL_VALUES = {"float32": "NaN", "int64": 0, "bool": False}

DIMENSIONS = {
    "observations": ("observation_row", "observation"),
    "actions": ("step", "action"),
    "episode_offsets": ("episode_boundary",),
}
"""Axes of the arrays that are not one value per step; an episode has one observation row more than steps."""

_CODECS = (
    {"name": "bytes", "configuration": {"endian": "little"}},
    {"name": "zstd", "configuration": {"level": 3, "checksum": False}},
    {"name": "crc32c"},
)
_ONE_BYTE_CODECS = ({"name": "bytes"}, *_CODECS[1:])
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def dimension_names(name: str) -> tuple[str, ...]:
    """The names of an array's axes, by which xarray lines up the arrays of a part."""
    return DIMENSIONS.get(name, ("step",))


@dataclass(frozen=True)
class ArrayLayout:
    """An array's files and sizes, from its checked `zarr.json`.

    Attributes:
        chunks: shape of every chunk; the last one along an axis is padded to it.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]

    @functools.cached_property
    def grid(self) -> tuple[int, ...]:
        """Number of chunks along each axis."""
        return tuple(-(-size // chunk) for size, chunk in zip(self.shape, self.chunks, strict=True))

    @property
    def chunk_bytes(self) -> int:
        """Bytes of one chunk once decoded."""
        return ITEM_BYTES[self.dtype] * prod(self.chunks)

    @property
    def decoded_bytes(self) -> int:
        """Bytes of all chunks once decoded."""
        return self.chunk_bytes * prod(self.grid)

    def files(self) -> list[str]:
        """Names in the archive of `zarr.json` and of every chunk that the shape calls for."""
        chunk_files = ("/".join(map(str, ("c", *index))) for index in product(*map(range, self.grid)))
        return [f"{ARRAYS}/{self.name}/{file}" for file in ("zarr.json", *chunk_files)]


def check_layout(archive: Archive, arrays: Mapping[str, Mapping[str, Any]]) -> list[ArrayLayout]:
    """Checks a part's `zarr.json` files against the allow-list and the part's own record.

    Args:
        archive: the part.
        arrays: name to `{"dtype", "shape", …}`, as the part's record has them.

    Raises:
        StoreError: names the file and the field.
    """
    _read_metadata(_GroupMetadata, archive, f"{ARRAYS}/zarr.json")
    layouts = []
    for name, record in arrays.items():
        layout = read_layout(archive, name)
        if layout.dtype != record["dtype"] or layout.shape != tuple(record["shape"]):
            raise StoreError(
                f"{archive.place(layout.files()[0])}: data_type {layout.dtype}, shape {list(layout.shape)} "
                f"are not what part.json records, {record['dtype']}, {list(record['shape'])}"
            )
        layouts.append(layout)
    return layouts


def read_layout(archive: Archive, name: str) -> ArrayLayout:
    """The layout of an array.

    Raises:
        StoreError: its `zarr.json` is missing or outside the allow-list.
    """
    file = f"{ARRAYS}/{name}/zarr.json"
    metadata = _read_metadata(_ArrayMetadata, archive, file)
    if metadata.dimension_names != dimension_names(name):
        raise StoreError(
            f"{archive.place(file)}: dimension_names {str(metadata.dimension_names)[:200]} are not "
            f"{dimension_names(name)}, those of {name}"
        )
    layout = ArrayLayout(name, metadata.data_type, metadata.shape, metadata.chunks)
    if prod(layout.grid) > MAX_CHUNKS:
        raise StoreError(
            f"{archive.place(file)}: shape {list(layout.shape)} calls for over {MAX_CHUNKS} chunks"
        )
    return layout


def check_expansion(layouts: Iterable[ArrayLayout], stored_bytes: int, place: object) -> None:
    """Refuses arrays that would decode to more than their size on disk justifies.

    Raises:
        StoreError: names the place.
    """
    decoded = sum(layout.decoded_bytes for layout in layouts)
    if decoded > max(DECODED_FLOOR, DECODED_RATIO * stored_bytes):
        raise StoreError(
            f"{place}: shape asks for {decoded} bytes, {stored_bytes} bytes on disk justify at most "
            f"{max(DECODED_FLOOR, DECODED_RATIO * stored_bytes)}"
        )


def chunk_problem(layout: ArrayLayout, data: bytes) -> str | None:
    """Why a chunk's bytes must not be decompressed, in words.

    The frame has to declare exactly the chunk's size: zstd then writes no byte beyond it.
    """
    declared = _frame_content_bytes(data)
    if declared is None:
        return "is no zstd frame of declared size"
    if declared != layout.chunk_bytes:
        return f"declares {declared} bytes instead of the chunk's {layout.chunk_bytes}"
    return None


def _frame_content_bytes(data: bytes) -> int | None:
    """The content size in a zstd frame's header (RFC 8878, 3.1.1.1); None where it has none."""
    if data[:4] != _ZSTD_MAGIC or len(data) < 6:
        return None
    descriptor = data[4]
    single_segment = descriptor >> 5 & 1
    start = 5 + (1 - single_segment) + (0, 1, 2, 4)[descriptor & 3]
    width = (single_segment, 2, 4, 8)[descriptor >> 6]
    if width == 0 or len(data) < start + width:
        return None
    return int.from_bytes(data[start : start + width], "little") + (256 if width == 2 else 0)


class _Metadata(BaseModel):
    """What every `zarr.json` of a part may say."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    zarr_format: Literal[3]
    attributes: dict[str, Any] = Field(default={}, max_length=0)


class _GroupMetadata(_Metadata):
    node_type: Literal["group"]


class _ChunkShape(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    chunk_shape: tuple[Annotated[int, Field(ge=1, lt=2**40)], ...]


class _ChunkGrid(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    name: Literal["regular"]
    configuration: _ChunkShape


class _ArrayMetadata(_Metadata):
    node_type: Literal["array"]
    data_type: Literal["float32", "int64", "bool"]
    shape: tuple[Annotated[int, Field(ge=0, lt=2**40)], ...] = Field(min_length=1, max_length=2)
    chunk_grid: _ChunkGrid
    chunk_key_encoding: dict[str, Any]
    codecs: tuple[dict[str, Any], ...]
    fill_value: str | float | bool
    dimension_names: tuple[str, ...]
    storage_transformers: tuple[Any, ...] = Field(default=(), max_length=0)

    @property
    def chunks(self) -> tuple[int, ...]:
        return self.chunk_grid.configuration.chunk_shape

    @model_validator(mode="after")
    def _as_written_here(self) -> "_ArrayMetadata":
        if len(self.dimension_names) != len(self.shape):
            raise ValueError(f"shape {self.shape} has not one axis per name in dimension_names")
        if len(self.chunks) != len(self.shape) or any(
            chunk > max(1, size) for chunk, size in zip(self.chunks, self.shape, strict=True)
        ):
            raise ValueError(f"chunk_grid {self.chunks} does not fit shape {self.shape}")
        if self.chunk_key_encoding != {"name": "default", "configuration": {"separator": "/"}}:
            raise ValueError(f"chunk_key_encoding {str(self.chunk_key_encoding)[:200]} is not allowed")
        if self.codecs not in (_CODECS, _ONE_BYTE_CODECS):
            raise ValueError(f"codecs {str(self.codecs)[:200]} are not allowed")
        if self.fill_value != FILL_VALUES[self.data_type]:
            raise ValueError(f"fill_value {str(self.fill_value)[:40]!r} is not allowed for {self.data_type}")
        return self


Metadata = TypeVar("Metadata", bound=_Metadata)


def _read_metadata(kind: type[Metadata], archive: Archive, name: str) -> Metadata:
    data = archive.read(name, limit=METADATA_BYTES)
    try:
        metadata: Metadata = _parse_metadata(kind, data)
        return metadata
    except ValidationError as error:
        detail = error.errors()[0]
        field = ".".join(map(str, detail["loc"])) or "values"
        raise StoreError(f"{archive.place(name)}: {field}: {detail['msg']}") from None
    except ValueError as error:
        raise StoreError(f"{archive.place(name)}: not readable as zarr.json ({one_line(error)})") from None


@functools.lru_cache(maxsize=512)  # parts of equally long episodes have the same files, byte for byte
def _parse_metadata(kind: type[Metadata], data: bytes) -> Metadata:
    return kind.model_validate_json(canonical_json(parse_json(data)))
