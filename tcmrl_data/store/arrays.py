"""Arrays of a part: the only file that imports zarr or its codecs. Trajectories in, arrays out, and back.

The arrays of a part are a Zarr v3 group in its archive. Steps of all episodes lie flat behind one another
with `episode_offsets`; observations hold one row more per episode, so that row `offset[e] + e + t` is o_t of
episode e and next observations are never stored twice.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise, product
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import sha256
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import one_line
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.layout import (
    ARRAYS,
    ArrayLayout,
    check_expansion,
    chunk_problem,
    dimension_names,
    read_layout,
)

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
    """The offsets of a part's episodes, if they rise from 0 to its number of steps.

    Raises:
        StoreError: they do not.
    """
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
            raise StoreError(f"{archive.place(name)} {problem}; run `tcmrl-data repair`")
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
                f"{archive.place(name)} does not decode ({one_line(error)}); run `tcmrl-data repair`"
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
