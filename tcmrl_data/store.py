"""Parts on disk: the only file that imports zarr. Trajectories in, flat chunked arrays out, and back.

A part is a Zarr v3 group. Steps of all episodes lie flat behind one another with `episode_offsets`;
observations hold one row more per episode, so that row `offset[e] + e + t` is o_t of episode e and
next observations are never stored twice.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from math import ceil, prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.canonical import canonical_json, parse_json, sha256
from tcmrl_data.errors import StoreError
from tcmrl_data.trajectory import Trajectory

Arrays = Mapping[str, npt.NDArray[np.generic]]

CHUNK_BYTES = 16 * 10**6
"""An array stays one chunk below this size (16 MB); above it, chunks are blocks of rows."""

STEP_ARRAYS = ("actions", "rewards", "terminated", "truncated")
DTYPES = {"float32": np.float32, "int64": np.int64, "bool": np.bool_}
GROUP = canonical_json({"zarr_format": 3, "node_type": "group", "attributes": {}})
_CODECS = (
    {"name": "bytes", "configuration": {"endian": "little"}},
    {"name": "zstd", "configuration": {"level": 3, "checksum": False}},
    {"name": "crc32c"},
)


def pack(trajectories: Sequence[Trajectory]) -> dict[str, npt.NDArray[np.generic]]:
    """Flat arrays of a part: floats as float32, flags as bool, `episode_offsets` int64 (episodes + 1)."""
    lengths = [len(trajectory) for trajectory in trajectories]
    floats = ("observations", "actions", "rewards")
    arrays: dict[str, npt.NDArray[np.generic]] = {
        name: np.concatenate([getattr(each, name) for each in trajectories]).astype(
            np.float32 if name in floats else np.bool_
        )
        for name in ("observations", *STEP_ARRAYS)
    }
    for name in trajectories[0].extras:
        arrays[name] = np.concatenate([each.extras[name] for each in trajectories])
    arrays["episode_offsets"] = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return arrays


def unpack(arrays: Arrays) -> list[Trajectory]:
    """The trajectories of a part's arrays, as views.

    Raises:
        StoreError: offsets that do not start at 0, do not rise, or do not end at the number of steps.
    """
    offsets = arrays["episode_offsets"]
    steps = len(arrays["actions"])
    if len(offsets) < 1 or offsets[0] != 0 or offsets[-1] != steps or np.any(np.diff(offsets) < 0):
        raise StoreError(f"episode_offsets must rise from 0 to {steps}, got {offsets[:3]} … {offsets[-1:]}")
    extras = [name for name in arrays if name not in {*STEP_ARRAYS, "observations", "episode_offsets"}]
    return [
        Trajectory(
            arrays["observations"][start + episode : stop + episode + 1],
            *(arrays[name][start:stop] for name in STEP_ARRAYS),
            {name: arrays[name][start:stop] for name in extras},
        )
        for episode, (start, stop) in enumerate(zip(offsets[:-1], offsets[1:], strict=True))
    ]


def write_arrays(folder: Path, arrays: Arrays) -> None:
    """Writes a part's arrays as a Zarr group into an empty folder.

    Every chunk is written, empty ones too: a missing chunk must never read as zeros.
    """
    import zarr
    from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec

    group = zarr.create_group(folder, zarr_format=3)
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
            config={"write_empty_chunks": True},
        )


def read_arrays(folder: Path, names: Iterable[str]) -> dict[str, npt.NDArray[np.generic]]:
    """Decodes arrays of a part.

    Raises:
        StoreError: a `zarr.json` outside the allow-list, a missing chunk, or bytes that do not decode.
    """
    import zarr

    result = {}
    for name in names:
        for file in array_files(folder, name):
            if not (folder / file).is_file():
                raise StoreError(f"{folder / file} is missing; rebuild the part")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                array = zarr.open_array(folder / name, mode="r", zarr_format=3)
                result[name] = np.asarray(array[...])
            except (ValueError, RuntimeError, OSError, TypeError, KeyError) as error:
                reason = " ".join(str(error).split())[:200]
                raise StoreError(f"{folder / name} does not decode ({reason}); rebuild the part") from None
    return result


def array_files(folder: Path, name: str) -> list[str]:
    """Relative paths of an array's `zarr.json` and of every chunk its shape calls for.

    Raises:
        StoreError: the `zarr.json` is missing or outside the allow-list.
    """
    shape, chunks, _ = _array_metadata(folder / name / "zarr.json")
    grid = [range(ceil(size / chunk)) for size, chunk in zip(shape, chunks, strict=True)]
    if prod(len(axis) for axis in grid) > 10**6:
        raise StoreError(f"{folder / name / 'zarr.json'}: chunks {chunks} of shape {shape} are too many")
    chunk_files = ["/".join(map(str, ("c", *index))) for index in product(*grid)]
    return [f"{name}/{file}" for file in ("zarr.json", *chunk_files)]


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


def check_layout(folder: Path, arrays: Mapping[str, Mapping[str, Any]]) -> None:
    """Checks a part's `zarr.json` files against the allow-list and the part's own record.

    Args:
        folder: the part.
        arrays: name to `{"dtype", "shape", …}`, as the part's record has them.

    Raises:
        StoreError: names the file and the field.
    """
    _group_metadata(folder / "zarr.json")
    for name, record in arrays.items():
        file = folder / name / "zarr.json"
        shape, _, dtype = _array_metadata(file)
        if list(shape) != list(record["shape"]) or dtype != record["dtype"]:
            raise StoreError(
                f"{file}: {dtype}{list(shape)} is not what part.json records, "
                f"{record['dtype']}{list(record['shape'])}"
            )


def _read_metadata(file: Path, keys: set[str]) -> dict[str, Any]:
    try:
        if file.stat().st_size > 2**16:
            raise StoreError(f"{file}: larger than any zarr.json of a part")
        metadata = parse_json(file.read_bytes())
    except (OSError, ValueError) as error:
        raise StoreError(f"{file}: not readable as zarr.json ({error})") from None
    if not isinstance(metadata, dict) or metadata.get("zarr_format") != 3:
        raise StoreError(f"{file}: zarr_format must be 3")
    unknown = sorted(set(metadata) - keys)
    if unknown:
        raise StoreError(f"{file}: field {unknown[0]!r} is not allowed")
    return metadata


def _group_metadata(file: Path) -> None:
    metadata = _read_metadata(file, {"zarr_format", "node_type", "attributes"})
    if metadata.get("node_type") != "group" or metadata.get("attributes") not in (None, {}):
        raise StoreError(f"{file}: must be a group without attributes")


def _array_metadata(file: Path) -> tuple[tuple[int, ...], tuple[int, ...], str]:
    """Shape, chunk shape and dtype of an allowed array."""
    allowed = "zarr_format node_type attributes shape data_type chunk_grid chunk_key_encoding fill_value codecs"
    metadata = _read_metadata(file, {*allowed.split(), "storage_transformers"})

    def require(field: str, ok: bool) -> None:
        if not ok:
            raise StoreError(f"{file}: {field} {str(metadata.get(field))[:80]} is not allowed")

    def is_shape(value: object, least: int) -> bool:
        return isinstance(value, list) and all(type(n) is int and least <= n < 2**40 for n in value)

    require("node_type", metadata.get("node_type") == "array")
    require("attributes", metadata.get("attributes") in (None, {}))
    require("storage_transformers", metadata.get("storage_transformers") in (None, []))
    require("data_type", metadata.get("data_type") in DTYPES)
    shape, grid = metadata.get("shape"), metadata.get("chunk_grid")
    require("shape", is_shape(shape, 0) and 1 <= len(shape) <= 2)
    require("chunk_grid", isinstance(grid, dict) and grid.get("name") == "regular")
    chunks = grid.get("configuration", {}).get("chunk_shape")
    require("chunk_grid", is_shape(chunks, 1) and len(chunks) == len(shape))
    default_keys = {"name": "default", "configuration": {"separator": "/"}}
    require("chunk_key_encoding", metadata.get("chunk_key_encoding") == default_keys)
    codecs = metadata.get("codecs")
    plain_bytes = ({"name": "bytes"}, *_CODECS[1:])  # one-byte types have no byte order
    require("codecs", isinstance(codecs, list) and tuple(codecs) in (_CODECS, plain_bytes))
    return tuple(shape), tuple(chunks), metadata["data_type"]
