"""Forged arrays of pickled objects for `tcmrl-data import`, each with one attack."""

import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile.source import TEBI, Make, Places
from tests.made_up import trajectory
from tests.test_import_idaq import RunsCode, saved


def npy(shape: str, content: bytes, *, descr: str = "'|O'") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


HEADERS = {
    "an empty file": b"",
    "half a magic": b"\x93NUM",
    "a header of numbers, 8 TiB": npy(f"({TEBI // 8},)", b"", descr="'<f8'"),
    "a header of objects, 8 TiB": npy(f"({TEBI}, 4)", pickle.dumps(np.zeros((1, 4), dtype=object))),
    "a header that computes": npy("(2**9999999,)", b""),
}


def rows(*cells: Any, length: int = 2) -> np.ndarray:
    made = np.empty((length, 4), dtype=object)
    for row in made:
        row[:] = cells
    return made


def objects(content: Any, protocol: int = 3) -> bytes:
    return npy("(2, 4)", pickle.dumps(content, protocol=protocol))


def global_call(module: str, name: str, argument: bytes) -> bytes:
    return b"\x80\x03c" + f"{module}\n{name}\n".encode() + argument + b"\x85R."


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def reconstructed(shape: bytes, kind: bytes, content: bytes) -> bytes:
    """A pickled array with a forged state."""
    start = b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
    dtype = (
        b"cnumpy\ndtype\n"
        + kind
        + b"\x89\x88\x87R(K\x03"
        + text("<")
        + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    )
    return start + b"(K\x01" + shape + dtype + b"\x89" + content + b"tb."


def long(value: int) -> bytes:
    data = value.to_bytes(8, "little", signed=True)
    return b"\x8a\x08" + data


def objects_at(pointers: bytes) -> bytes:
    """An array whose type says objects and, by its flags, that they are stored as plain bytes."""
    return npy(
        "(2, 4)", reconstructed(b"K\x01K\x04\x86", text("O8"), b"C" + bytes([len(pointers)]) + pointers)
    )


CODE: dict[str, bytes] = {
    "builtins.eval": npy("(2, 4)", global_call("builtins", "eval", text("1"))),
    "a file by numpy": npy("(2, 4)", global_call("numpy", "fromfile", text("/etc/passwd"))),
    "a memory map": npy(
        "(2, 4)", b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nmemmap\nK\x00\x85C\x01b\x87R."
    ),
    "a subclass by INST": npy("(2, 4)", b"(S'touch x'\nios\nsystem\n."),
    "a table": npy("(2, 4)", pickle.dumps({"a": 1}, protocol=3)),
    "a memo of 16 GiB": npy("(2, 4)", b"\x80\x03Nr\xff\xff\xff\x7f0."),
    "bytes of 8 TiB": npy("(2, 4)", b"\x80\x04\x8e" + struct.pack("<Q", TEBI) + b"x."),
    "a million lists": npy("(2, 4)", b"\x80\x03" + b"]" * 10**6 + b"a" * (10**6 - 1) + b"."),
    "numbers of 8 TiB": npy("(2, 4)", reconstructed(long(TEBI // 8) + b"\x85", text("f8"), b"C\x01x")),
    "objects without elements": npy("(2, 4)", reconstructed(long(TEBI) + b"K\x04\x86", text("O8"), b"]")),
    "a type of 8 TiB": npy("(2, 4)", reconstructed(b"K\x01\x85", text(f"V{TEBI}"), b"C\x01x")),
    "another shape than the header's": npy(
        "(1, 4)", pickle.dumps(rows(np.zeros(2), np.zeros(1), 0.0, np.zeros(2)))
    ),
    "cells of objects": objects(rows(*[rows(1, 2, 3, 4)] * 4)),
    "rows of different widths": objects(
        np.array(
            [[np.zeros(2), np.zeros(1), 0.0, np.zeros(2)], [np.zeros(3), np.zeros(1), 0.0, np.zeros(3)]],
            dtype=object,
        )
    ),
    "values that are not finite": objects(rows(np.full(2, np.inf), np.zeros(1), 0.0, np.zeros(2))),
    "an array that was never filled": npy(
        "(0, 4)", b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87\x81."
    ),
    "a pointer in place of an object": objects_at(b"AAAAAAAA"),
    "other defaults for a function": npy(
        "(2, 4)",
        b"\x80\x03cnumpy.core.multiarray\n_reconstruct\nN}X\x0c\x00\x00\x00__defaults__N)s\x86b.",
    ),
    "one array in many rows": npy(
        "(200000, 4)",
        pickle.dumps(rows(np.zeros(50_000), np.zeros(1), 0.0, np.zeros(50_000), length=200_000)),
    ),
}


def episode_file(places: Places) -> Path:
    file = places.folder / "goal_idx0" / "trj_evalsample0_step0.npy"
    file.parent.mkdir(parents=True)
    return file


def written(content: bytes) -> Make:
    def make(places: Places) -> Path:
        episode_file(places).write_bytes(content)
        return places.folder

    return make


def runs_code(places: Places) -> Path:
    episode_file(places).write_bytes(objects(rows(RunsCode(places.marker), 0, 0, 0)))
    return places.folder


def cut(share: float) -> Make:
    def make(places: Places) -> Path:
        file = saved(episode_file(places), trajectory(20, seed=0))
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        return places.folder

    return make


def pipe(places: Places) -> Path:
    os.mkfifo(episode_file(places))
    return places.folder


IDAQ: dict[str, Make] = (
    {f"npy: {name}": written(content) for name, content in (HEADERS | CODE).items()}
    | {f"npy: cut at {share}": cut(share) for share in (0.2, 0.5, 0.99)}
    | {
        "npy: code": runs_code,
        "npy: a pipe": pipe,
    }
)
