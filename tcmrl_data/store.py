"""Parts on disk: the only file that imports zarr. Trajectories in, flat chunked arrays out, and back.

A part is a Zarr v3 group. Steps of all episodes lie flat behind one another with `episode_offsets`;
observations hold one row more per episode, so that row `offset[e] + e + t` is o_t of episode e and
next observations are never stored twice.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise, product
from math import ceil, prod
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tcmrl_data.canonical import canonical_json, parse_json, sha256
from tcmrl_data.errors import StoreError
from tcmrl_data.trajectory import Trajectory

Arrays = Mapping[str, npt.NDArray[Any]]

CHUNK_BYTES = 16 * 10**6
"""An array stays one chunk below this size (16 MB); above it, chunks are blocks of rows."""

STEP_ARRAYS = ("actions", "rewards", "terminated", "truncated")
METADATA_BYTES = 2**16
MAX_CHUNKS = 10**6
GROUP = canonical_json({"zarr_format": 3, "node_type": "group", "attributes": {}})
_CODECS = (
    {"name": "bytes", "configuration": {"endian": "little"}},
    {"name": "zstd", "configuration": {"level": 3, "checksum": False}},
    {"name": "crc32c"},
)
_ONE_BYTE_CODECS = ({"name": "bytes"}, *_CODECS[1:])


def pack(trajectories: Sequence[Trajectory]) -> dict[str, npt.NDArray[Any]]:
    """Flat arrays of a part: floats as float32, flags as bool, `episode_offsets` int64 (episodes + 1)."""
    lengths = [len(trajectory) for trajectory in trajectories]
    floats = ("observations", "actions", "rewards")
    arrays: dict[str, npt.NDArray[Any]] = {
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
            arrays["actions"][start:stop],
            arrays["rewards"][start:stop],
            arrays["terminated"][start:stop],
            arrays["truncated"][start:stop],
            {name: arrays[name][start:stop] for name in extras},
        )
        for episode, (start, stop) in enumerate(pairwise(offsets))
    ]


def encode_arrays(arrays: Arrays) -> dict[str, bytes]:
    """The files of a part's Zarr group: relative path to content.

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
            config={"write_empty_chunks": True},
        )
    return {name: buffer.to_bytes() for name, buffer in files.items()}


def read_arrays(folder: Path, names: Iterable[str]) -> dict[str, npt.NDArray[Any]]:
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
    metadata = _read_metadata(_ArrayMetadata, folder / name / "zarr.json")
    grid = [range(ceil(size / chunk)) for size, chunk in zip(metadata.shape, metadata.chunks, strict=True)]
    if prod(len(axis) for axis in grid) > MAX_CHUNKS:
        raise StoreError(f"{folder / name / 'zarr.json'}: more than {MAX_CHUNKS} chunks")
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
    _read_metadata(_GroupMetadata, folder / "zarr.json")
    for name, record in arrays.items():
        file = folder / name / "zarr.json"
        metadata = _read_metadata(_ArrayMetadata, file)
        if metadata.data_type != record["dtype"] or list(metadata.shape) != list(record["shape"]):
            raise StoreError(
                f"{file}: {metadata.data_type}{list(metadata.shape)} is not what part.json records, "
                f"{record['dtype']}{list(record['shape'])}"
            )


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
    storage_transformers: tuple[Any, ...] = Field(default=(), max_length=0)

    @property
    def chunks(self) -> tuple[int, ...]:
        return self.chunk_grid.configuration.chunk_shape

    @model_validator(mode="after")
    def _as_written_here(self) -> "_ArrayMetadata":
        if len(self.chunks) != len(self.shape):
            raise ValueError(f"chunk_grid {self.chunks} does not fit shape {self.shape}")
        if self.chunk_key_encoding != {"name": "default", "configuration": {"separator": "/"}}:
            raise ValueError(f"chunk_key_encoding {self.chunk_key_encoding} is not allowed")
        if self.codecs not in (_CODECS, _ONE_BYTE_CODECS):
            raise ValueError(f"codecs {str(self.codecs)[:200]} are not allowed")
        return self


Metadata = TypeVar("Metadata", bound=_Metadata)


def _read_metadata(kind: type[Metadata], file: Path) -> Metadata:
    try:
        if file.stat().st_size > METADATA_BYTES:
            raise StoreError(f"{file}: larger than any zarr.json of a part")
        return kind.model_validate_json(canonical_json(parse_json(file.read_bytes())))
    except ValidationError as error:
        detail = error.errors()[0]
        field = ".".join(map(str, detail["loc"])) or "values"
        raise StoreError(f"{file}: {field}: {detail['msg']}") from None
    except (OSError, ValueError) as error:
        raise StoreError(f"{file}: not readable as zarr.json ({error})") from None
