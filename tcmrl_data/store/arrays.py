"""Arrays of a part: trajectories in, a Zarr v3 group in its archive out, and back.

Steps of all episodes lie flat behind one another with `episode_offsets`; observations hold one row more per
episode, so that row `offset[e] + e + t` is o_t of episode e and next observations are never stored twice.

A `zarr.json` is compared with what is written here before a byte is decoded, and nothing is decoded that the
size on disk does not justify: arrays may decode to 64 MiB, or to 256 times their files where that is more
(real parts: at most about 12 times, since sampled actions do not compress).
"""

import contextlib
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.files import one_line
from tcmrl_data.foundation.records import differences, parse_json, sha256
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

_ENDIAN = {"configuration": {"endian": "little"}}
_COMPRESSORS = ({"name": "zstd", "configuration": {"level": 3, "checksum": False}}, {"name": "crc32c"})
_GROUP = {"zarr_format": 3, "node_type": "group", "attributes": {}}
_OPTIONAL: dict[str, Any] = {"attributes": {}, "storage_transformers": []}
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

    @property
    def document(self) -> dict[str, Any]:
        """The fields of its `zarr.json` that must be there."""
        endian = _ENDIAN if ITEM_BYTES[self.dtype] > 1 else {}
        return {
            "zarr_format": 3,
            "node_type": "array",
            "data_type": self.dtype,
            "shape": list(self.shape),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunks)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "codecs": [{"name": "bytes", **endian}, *_COMPRESSORS],
            "fill_value": FILL_VALUES[self.dtype],
            "dimension_names": list(dimension_names(self.name)),
        }

    def files(self) -> list[str]:
        """Names in the archive of `zarr.json` and of every chunk that the shape calls for."""
        chunk_files = ("/".join(map(str, ("c", *index))) for index in product(*map(range, self.grid)))
        return [f"{ARRAYS}/{self.name}/{file}" for file in ("zarr.json", *chunk_files)]


def check_layout(archive: Archive, arrays: Mapping[str, Mapping[str, Any]]) -> list[ArrayLayout]:
    """Checks a part's `zarr.json` files against what is written here and the part's own record.

    Args:
        arrays: name to `{"dtype", "shape", …}`, as the part's record has them.
    """
    with _named_metadata(archive, f"{ARRAYS}/zarr.json") as data:
        _check_equal({"attributes": {}} | _parse_table(data), _GROUP)
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
        StoreError: its `zarr.json` is missing, or not as it is written here.
    """
    file = f"{ARRAYS}/{name}/zarr.json"
    with _named_metadata(archive, file) as data:
        return _parse_layout(name, data)


@contextlib.contextmanager
def _named_metadata(archive: Archive, file: str) -> Iterator[bytes]:
    """The content of a `zarr.json`; names the file in errors of the block."""
    data = archive.read(file, limit=METADATA_BYTES)
    try:
        yield data
    except ValueError as error:
        raise StoreError(f"{archive.place(file)}: not readable as zarr.json ({one_line(error)})") from None


def check_expansion(layouts: Iterable[ArrayLayout], stored_bytes: int, place: object) -> None:
    """Refuses arrays that would decode to more than their size on disk justifies."""
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


@functools.lru_cache(maxsize=512)  # parts of equally long episodes have the same files, byte for byte
def _parse_layout(name: str, data: bytes) -> ArrayLayout:
    """The layout in an array's `zarr.json`; raises `ValueError` for anything but what is written here."""
    found = _OPTIONAL | _parse_table(data)
    dtype = found.get("data_type")
    if not isinstance(dtype, str) or dtype not in ITEM_BYTES:
        raise ValueError(f"data_type {str(dtype)[:80]} is not allowed")
    try:
        chunks = found["chunk_grid"]["configuration"]["chunk_shape"]
    except (LookupError, TypeError):
        raise ValueError("chunk_grid has no chunk_shape") from None
    layout = ArrayLayout(
        name,
        dtype,
        _sizes(found.get("shape"), "shape", least=0),
        _sizes(chunks, "chunk_grid.configuration.chunk_shape", least=1),
    )
    if len(layout.shape) != len(dimension_names(name)):
        raise ValueError(f"shape {list(layout.shape)} has not the axes of {name}")
    if len(chunks) != len(layout.shape) or any(
        chunk > max(1, size) for chunk, size in zip(chunks, layout.shape, strict=True)
    ):
        raise ValueError(f"chunk_grid {chunks} does not fit shape {list(layout.shape)}")
    if prod(layout.grid) > MAX_CHUNKS:
        raise ValueError(f"shape {list(layout.shape)} calls for over {MAX_CHUNKS} chunks")
    _check_equal(found, _OPTIONAL | layout.document)
    return layout


def _parse_table(data: bytes) -> dict[str, Any]:
    values = parse_json(data)
    if not isinstance(values, dict):
        raise ValueError("it is no table")
    return values


def _sizes(value: Any, what: str, *, least: int) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(size) is int and least <= size < 2**40 for size in value):
        raise ValueError(f"{what} {str(value)[:80]} is not allowed")
    return tuple(value)


def _check_equal(found: Mapping[str, Any], written: Mapping[str, Any]) -> None:
    for place, value, _ in differences(found, written):
        raise ValueError(f"{place[:80]} {str(value)[:80]} is not allowed")


Arrays = Mapping[str, npt.NDArray[Any]]

CHUNK_BYTES = 16 * 10**6
"""An array stays one chunk below this size (16 MB); above it, chunks are blocks of rows."""

STEP_ARRAYS = ("actions", "rewards", "terminated", "truncated")


def pack(trajectories: Sequence[Trajectory]) -> dict[str, npt.NDArray[Any]]:
    """Flat arrays of a part: floats as float32, flags as bool, `episode_offsets` int64 (episodes + 1)."""
    lengths = [len(trajectory) for trajectory in trajectories]
    floats = ("observations", "actions", "rewards")
    arrays: dict[str, npt.NDArray[Any]] = {
        name: np.concatenate([getattr(trajectory, name) for trajectory in trajectories]).astype(
            np.float32 if name in floats else np.bool_
        )
        for name in ("observations", *STEP_ARRAYS)
    }
    for name in trajectories[0].extras:
        arrays[name] = np.concatenate([trajectory.extras[name] for trajectory in trajectories])
    arrays["episode_offsets"] = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return arrays


def unpack(arrays: Arrays) -> list[Trajectory]:
    """The trajectories of a part's arrays, as views.

    Raises:
        StoreError: offsets that do not start at 0, do not rise, or do not end at the number of steps.
    """
    offsets = checked_offsets(arrays["episode_offsets"], len(arrays["actions"]))
    extras = [name for name in arrays if name not in {*STEP_ARRAYS, "observations", "episode_offsets"}]
    return [
        Trajectory(
            arrays["observations"][start + episode : stop + episode + 1],
            arrays["actions"][start:stop],
            arrays["rewards"][start:stop],
            arrays["terminated"][start:stop],
            arrays["truncated"][start:stop],
            {name: arrays[name][start:stop] for name in extras},
        )
        for episode, (start, stop) in enumerate(pairwise(offsets))
    ]


def checked_offsets(offsets: npt.NDArray[np.int64], steps: int) -> npt.NDArray[np.int64]:
    """The offsets of a part's episodes, if they rise from 0 to its number of steps."""
    if (
        len(offsets) < 1
        or offsets[0] != 0
        or offsets[-1] != steps
        or np.any(offsets[1:] < offsets[:-1])  # a difference of two int64 may wrap around
    ):
        raise StoreError(f"episode_offsets must rise from 0 to {steps}, got {offsets[:3]} … {offsets[-1:]}")
    return offsets


def encode_arrays(arrays: Arrays) -> dict[str, bytes]:
    """The files of a part's Zarr group: name in the archive to content.

    Every chunk is there, empty ones too: a missing chunk must never read as zeros.
    """
    import zarr
    from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    group = zarr.create_group(MemoryStore(files), zarr_format=3)
    for name, array in arrays.items():
        rows = max(1, len(array))
        row_bytes = max(1, array.nbytes // rows)
        chunk_rows = rows if array.nbytes < CHUNK_BYTES else max(1, CHUNK_BYTES // row_bytes)
        group.create_array(
            name,
            data=np.ascontiguousarray(array),
            chunks=(chunk_rows, *array.shape[1:]),
            serializer=BytesCodec(),
            compressors=[ZstdCodec(level=3), Crc32cCodec()],
            fill_value=np.nan if array.dtype.kind == "f" else array.dtype.type(0),
            dimension_names=dimension_names(name),
            config={"write_empty_chunks": True},
        )
    return {f"{ARRAYS}/{name}": buffer.to_bytes() for name, buffer in sorted(files.items())}


def read_arrays(archive: Archive, names: Iterable[str]) -> dict[str, npt.NDArray[Any]]:
    """Decodes arrays of a part.

    Raises:
        StoreError: a `zarr.json` outside the allow-list, a missing chunk, arrays larger than their chunks
            justify, or bytes that do not decode.
    """
    layouts = [read_layout(archive, name) for name in names]
    chunks = {layout.name: _read_chunks(archive, layout) for layout in layouts}
    stored = sum(len(data) for files in chunks.values() for data in files)
    check_expansion(layouts, stored, archive.path)
    return {layout.name: _decode(archive, layout, chunks.pop(layout.name)) for layout in layouts}


def _read_chunks(archive: Archive, layout: ArrayLayout) -> list[bytes]:
    """The chunks of an array in order, checked to be of their declared size."""
    limit = 2**16 + layout.chunk_bytes + layout.chunk_bytes // 64
    chunks = []
    for name in layout.files()[1:]:  # the first is zarr.json, which the layout came from
        data = archive.read_unchecked(name, limit=limit)  # decoding compares the chunk's own checksum
        problem = chunk_problem(layout, data)
        if problem:
            raise StoreError(f"{archive.place(name)} {problem}; run `tcmrl-data verify --repair`")
        chunks.append(data)
    return chunks


def _decode(archive: Archive, layout: ArrayLayout, chunks: Sequence[bytes]) -> npt.NDArray[Any]:
    """An array from its chunks: the three codecs of the allow-list undone, without zarr's own overhead.

    zstd decodes without the interpreter's lock, so that parts can be read side by side.
    """
    array = np.empty(layout.shape, dtype=layout.dtype)
    for index, name, data in zip(product(*map(range, layout.grid)), layout.files()[1:], chunks, strict=True):
        corner = [i * size for i, size in zip(index, layout.chunks, strict=True)]
        target = array[tuple(slice(at, at + size) for at, size in zip(corner, layout.chunks, strict=True))]
        whole = target.shape == layout.chunks and target.flags.c_contiguous
        chunk = target if whole else np.empty(layout.chunks, dtype=layout.dtype)
        try:
            _decode_chunk(data, chunk)
        except (ValueError, RuntimeError) as error:
            raise StoreError(
                f"{archive.place(name)} does not decode ({one_line(error)}); run `tcmrl-data verify --repair`"
            ) from None
        if not whole:
            target[...] = chunk[tuple(map(slice, target.shape))]
    return array


def _decode_chunk(data: bytes, out: npt.NDArray[Any]) -> None:
    """Decodes zstd, then crc32c (both of a chunk's codecs but the plain bytes) into an array."""
    import google_crc32c
    from numcodecs.zstd import Zstd

    body, checksum = data[:-4], data[-4:]
    if google_crc32c.value(body).to_bytes(4, "little") != checksum:
        raise ValueError("its checksum does not match")
    Zstd().decode(body, out)


def array_digests(arrays: Arrays) -> dict[str, dict[str, Any]]:
    """dtype, shape and sha256 of the decoded little-endian bytes of every array."""
    return {
        name: {
            "dtype": str(array.dtype),
            "shape": list(array.shape),
            "sha256": sha256(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data),
        }
        for name, array in arrays.items()
    }
