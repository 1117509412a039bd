"""Forged layouts and chunks of arrays."""

from typing import Any

import numpy as np

from tests.hostile.case import Damage, in_part
from tests.hostile.datasets import Forge, offsets, rle_frame, with_checksum


def _zarr(array: str = "rewards", **fields: Any) -> Damage:
    return lambda forge: forge.zarr(array, **fields)


def _chunk(data: bytes) -> Damage:
    return lambda forge: forge.write("rewards/c/0", data)


def _bomb(forge: Forge) -> None:
    """Every array claims 2**26 steps; one array really decodes to that many."""
    forge.lengthen(2**26)
    forge.write("terminated/c/0", rle_frame(2**26))


def _nan_array(forge: Forge) -> None:
    """NaN rewards with consistent digests."""
    forge.values("rewards", lambda array: array.__setitem__(7, np.nan))


def _offsets(values: list[int]) -> Damage:
    return lambda forge: forge.encode(offsets(values))


BIG = 2**63 - 1

LAYOUTS = [
    in_part("no metadata", lambda f: f.take("rewards/zarr.json"), "rewards/zarr.json", "missing"),
    in_part("object dtype", _zarr(data_type="|O"), "rewards/zarr.json", "data_type"),
    in_part("pickle codec", _zarr(codecs=[{"name": "numcodecs.pickle"}]), "rewards/zarr.json", "codecs"),
    in_part("negative rows", _zarr(shape=[-1]), "rewards/zarr.json", "shape"),
    in_part("rows beyond int64", _zarr(shape=[2**70]), "rewards/zarr.json", "shape"),
    in_part("ten axes", _zarr(shape=[1] * 10), "rewards/zarr.json", "shape"),
    in_part("petabytes", lambda f: f.lengthen(2**39), "", "shape asks for"),
    in_part(
        "huge chunks",
        _zarr(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**39]}}),
        "rewards/zarr.json",
        "chunk_grid",
    ),
    in_part(
        "empty chunks",
        _zarr(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [0]}}),
        "rewards/zarr.json",
        "chunk_shape",
    ),
    in_part("unknown field", _zarr(must_understand=True), "rewards/zarr.json", "must_understand"),
    in_part(
        "metadata big", lambda f: f.write("rewards/zarr.json", b" " * 10**6), "rewards/zarr.json", "bytes"
    ),
    in_part(
        "group attributes",
        lambda f: f.write("zarr.json", b'{"zarr_format":3,"node_type":"group","attributes":{"x":1}}'),
        "arrays/zarr.json",
        "attributes",
    ),
]

CHUNKS = [
    in_part("bomb beyond the chunk", _chunk(rle_frame(2**24, declared=2**24)), "rewards/c/0", "declares"),
    in_part("bomb declared small", _chunk(rle_frame(2**24, declared=480)), "rewards", "does not decode"),
    in_part(
        "frame without size",
        _chunk(with_checksum(b"\x28\xb5\x2f\xfd\x00\x58" + b"\x03\x00\x00\x00")),
        "rewards/c/0",
        "zstd frame",
    ),
    in_part(
        "two frames",
        lambda f: f.write("rewards/c/0", with_checksum(2 * rle_frame(480)[:-4])),
        "rewards",
        "does not decode",
    ),
    in_part("justified by nothing", _bomb, "", "shape asks for"),
    in_part(
        "a pickle as chunk",
        lambda f: f.write("rewards/c/0", f.payload()),
        "rewards/c/0",
        "zstd frame",
    ),
    in_part("empty chunk", _chunk(b""), "rewards/c/0", "zstd frame"),
    in_part("wrong checksum", _chunk(rle_frame(480)[:-4] + b"\0\0\0\0"), "rewards", "does not decode"),
    in_part("other values", _chunk(rle_frame(480)), "rewards", "sha256", "verify"),
    in_part("NaN rewards", _nan_array, "rewards", "not finite", "verify"),
    in_part("offsets fall", _offsets([0, 20, 40, 30, 80, 100, 120]), "", "episode_offsets"),
    in_part(
        "offsets wrap",
        _offsets([0, BIG, -BIG - 1, -1, 80, 100, 120]),
        "",
        "episode_offsets",
    ),
    in_part(
        "episodes moved",
        _offsets([0, 20, 40, 60, 80, 101, 120]),
        "terminated",
        "last step",
        "verify",
    ),
]
