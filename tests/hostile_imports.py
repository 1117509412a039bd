"""Forged files for `tcmrl-data import`, each with one attack."""

import json
import os
import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from tests.made_up import trajectory
from tests.test_import_idaq import RunsCode, saved

TEBI = 2**43


class Places(NamedTuple):
    """Where a case writes: its own folder, a file that nobody may read, a file that code would make."""

    folder: Path
    secret: Path
    marker: Path


Make = Callable[[Places], Path]
PICKLES: dict[str, Callable[[Places], bytes]] = {}
HEADERS: dict[str, bytes] = {
    "an empty file": b"",
    "half a magic": b"\x93NUM",
    "an unknown version": b"\x93NUMPY\x09\x00\x10\x00" + b" " * 16,
    "a header of numbers, 8 TiB": b"",
    "a header of objects, 8 TiB": b"",
    "a header that is no table": b"",
    "a header of brackets": b"",
    "a header that computes": b"",
}


def npy(shape: str, content: bytes, *, descr: str = "'|O'") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


HEADERS["a header of numbers, 8 TiB"] = npy(f"({TEBI // 8},)", b"", descr="'<f8'")
HEADERS["a header of objects, 8 TiB"] = npy(f"({TEBI}, 4)", pickle.dumps(np.zeros((1, 4), dtype=object)))
HEADERS["a header that is no table"] = npy("(), 'more': ", b"")
HEADERS["a header of brackets"] = npy("(" * 9_000, b"")
HEADERS["a header that computes"] = npy("(2**9999999,)", b"")


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


CODE: dict[str, bytes] = {
    "builtins.eval": npy("(2, 4)", global_call("builtins", "eval", text("1"))),
    "a file by numpy": npy("(2, 4)", global_call("numpy", "fromfile", text("/etc/passwd"))),
    "a memory map": npy(
        "(2, 4)", b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nmemmap\nK\x00\x85C\x01b\x87R."
    ),
    "a name with dots": npy(
        "(2, 4)", b"\x80\x04" + text("numpy") + text("os.system") + b"\x93" + text("x") + b"\x85R."
    ),
    "a subclass by INST": npy("(2, 4)", b"(S'touch x'\nios\nsystem\n."),
    "a reference outside": npy("(2, 4)", b"\x80\x03K\x01Q."),
    "an extension": npy("(2, 4)", b"\x80\x03\x82\x01."),
    "a table": npy("(2, 4)", pickle.dumps({"a": 1}, protocol=3)),
    "a memo of 16 GiB": npy("(2, 4)", b"\x80\x03Nr\xff\xff\xff\x7f0."),
    "bytes of 8 TiB": npy("(2, 4)", b"\x80\x04\x8e" + struct.pack("<Q", TEBI) + b"x."),
    "a bytearray of 8 TiB": npy("(2, 4)", b"\x80\x05\x96" + struct.pack("<Q", TEBI) + b"x."),
    "bytes of 2 GiB": npy("(2, 4)", b"\x80\x03B" + struct.pack("<I", 2**31) + b"x."),
    "a frame of 8 TiB": npy("(2, 4)", b"\x80\x04\x95" + struct.pack("<Q", TEBI) + b"N."),
    "a million tuples": npy("(2, 4)", b"\x80\x03N" + b"\x85" * 10**6 + b"."),
    "a million marks": npy("(2, 4)", b"\x80\x03" + b"(" * 10**6 + b"."),
    "a million memos": npy("(2, 4)", b"\x80\x04N" + b"\x94" * 10**6 + b"."),
    "a million lists": npy("(2, 4)", b"\x80\x03" + b"]" * 10**6 + b"a" * (10**6 - 1) + b"."),
    "numbers of 8 TiB": npy("(2, 4)", reconstructed(long(TEBI // 8) + b"\x85", text("f8"), b"C\x01x")),
    "objects without elements": npy("(2, 4)", reconstructed(long(TEBI) + b"K\x04\x86", text("O8"), b"]")),
    "a negative shape": npy("(2, 4)", reconstructed(long(-1) + b"\x85", text("f8"), b"C\x00")),
    "a shape that is no number": npy(
        "(2, 4)", reconstructed(text("8") + b"\x85", text("f8"), b"C\x08xxxxxxxx")
    ),
    "a type of 8 TiB": npy("(2, 4)", reconstructed(b"K\x01\x85", text(f"V{TEBI}"), b"C\x01x")),
    "another shape than the header's": npy(
        "(1, 4)", pickle.dumps(rows(np.zeros(2), np.zeros(1), 0.0, np.zeros(2)))
    ),
    "cells of texts": objects(rows("a", "b", "c", "d")),
    "cells of objects": objects(rows(*[rows(1, 2, 3, 4)] * 4)),
    "rows of different widths": objects(
        np.array(
            [[np.zeros(2), np.zeros(1), 0.0, np.zeros(2)], [np.zeros(3), np.zeros(1), 0.0, np.zeros(3)]],
            dtype=object,
        )
    ),
    "values that are not finite": objects(rows(np.full(2, np.inf), np.zeros(1), 0.0, np.zeros(2))),
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


def linked_file(places: Places) -> Path:
    saved(places.secret, trajectory(5, seed=0))
    episode_file(places).symlink_to(places.secret)
    return places.folder


def linked_folder(places: Places) -> Path:
    saved(places.secret.parent / "trj_evalsample0_step0.npy", trajectory(5, seed=0))
    places.folder.mkdir()
    (places.folder / "goal_idx0").symlink_to(places.secret.parent)
    return places.folder


def pipe(places: Places) -> Path:
    os.mkfifo(episode_file(places))
    return places.folder


IDAQ: dict[str, Make] = (
    {f"npy: {name}": written(content) for name, content in (HEADERS | CODE).items()}
    | {f"npy: cut at {share}": cut(share) for share in (0.2, 0.5, 0.99)}
    | {
        "npy: code": runs_code,
        "npy: a link": linked_file,
        "npy: a linked folder": linked_folder,
        "npy: a pipe": pipe,
    }
)

FLAT = {
    "observations": np.zeros((64, 2), dtype=np.float32),
    "next_observations": np.zeros((64, 2), dtype=np.float32),
    "actions": np.zeros((64, 1), dtype=np.float32),
    "rewards": np.zeros(64, dtype=np.float32),
    "terminals": np.zeros(64, dtype=bool),
}


def hdf5(change: Callable[[h5py.File, Places], object], *, without: str = "observations") -> Make:
    """A sound file in which something takes the place of the observations."""

    def make(places: Places) -> Path:
        places.folder.mkdir(exist_ok=True)
        path = places.folder / "flat.hdf5"
        with h5py.File(path, "w") as file:
            for name, array in FLAT.items():
                if name != without:
                    file[name] = array
            change(file, places)
        return path

    return make


def secret_file(places: Places) -> str:
    with h5py.File(places.secret, "w") as file:
        file["observations"] = FLAT["observations"]
    return str(places.secret)


def virtual(file: h5py.File, places: Places) -> None:
    layout = h5py.VirtualLayout((64, 2), dtype=np.float32)
    layout[:] = h5py.VirtualSource(secret_file(places), "observations", (64, 2))
    file.create_virtual_dataset("observations", layout)


def external(file: h5py.File, places: Places) -> None:
    places.secret.write_bytes(bytes(512))
    file.create_dataset("observations", (64, 2), np.float32, external=[(str(places.secret), 0, 512)])


def overfull_chunk(file: h5py.File, places: Places) -> None:
    """A chunk that says 512 bytes and unpacks to 256 MiB."""
    made = file.create_dataset("observations", (64, 2), np.float32, chunks=(64, 2), compression="gzip")
    made.id.write_direct_chunk((0, 0), zlib.compress(bytes(2**28), 9))


def looped(places: Places) -> Path:
    """Our own layout, in which a million episodes are one: groups that hold themselves."""
    places.folder.mkdir()
    path = places.folder / "ours.hdf5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "tcmrl-hdf5", "format_version": 1, "task": 0, "split": "train"})
        file.attrs["parameters"] = "{}"
        first = file.create_group("episodes/000000")
        first.attrs["step"] = 0
        arrays = {
            "observations": np.zeros((20_001, 2), dtype=np.float32),
            "actions": np.zeros((20_000, 1), dtype=np.float32),
            "rewards": np.zeros(20_000, dtype=np.float32),
            "terminated": np.zeros(20_000, dtype=bool),
            "truncated": np.zeros(20_000, dtype=bool),
        }
        for name, array in arrays.items():
            first.create_dataset(name, data=array, compression="gzip")
        for number in range(1, 2_000):
            file[f"episodes/{number:06d}"] = first
    return path


def ours(**attributes: Any) -> Make:
    def make(places: Places) -> Path:
        places.folder.mkdir()
        path = places.folder / "ours.hdf5"
        with h5py.File(path, "w") as file:
            plain = {
                "format": "tcmrl-hdf5",
                "format_version": 1,
                "task": 0,
                "split": "train",
                "parameters": "{}",
            }
            file.attrs.update(plain | {name: value for name, value in attributes.items() if name != "step"})
            group = file.create_group("episodes/000000")
            group.attrs["step"] = attributes.get("step", 0)
            ended = np.array([False, True])
            for name, array in (
                ("observations", np.zeros((3, 1), dtype=np.float32)),
                ("actions", np.zeros((2, 1), dtype=np.float32)),
                ("rewards", np.zeros(2, dtype=np.float32)),
                ("terminated", ended),
                ("truncated", ~ended if attributes.get("early") else ended),
            ):
                group[name] = array
        return path

    return make


def endless_heap(entry: bytes) -> Make:
    """Our own layout with a text whose heap the library would walk for ever, or beyond its end."""

    def make(places: Places) -> Path:
        path = ours()(places)
        content = bytearray(path.read_bytes())
        first = content.index(b"GCOL") + 16
        content[first : first + len(entry)] = entry
        path.write_bytes(content)
        return path

    return make


def shortened(share: float) -> Make:
    def make(places: Places) -> Path:
        path = hdf5(lambda file, _: None, without="")(places)
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        return path

    return make


def not_hdf5(places: Places) -> Path:
    places.folder.mkdir()
    (places.folder / "no.hdf5").write_bytes(os.urandom(10_000))
    return places.folder / "no.hdf5"


def pipe_file(places: Places) -> Path:
    places.folder.mkdir()
    os.mkfifo(places.folder / "pipe.hdf5")
    return places.folder / "pipe.hdf5"


def replaced(value: Any, **options: Any) -> Make:
    return hdf5(lambda file, _: file.create_dataset("observations", data=value, **options))


def shaped(shape: tuple[int, ...], **options: Any) -> Make:
    return hdf5(lambda file, _: file.create_dataset("observations", shape, np.float32, **options))


HDF5: dict[str, Make] = {
    "hdf5: an external link": hdf5(
        lambda file, places: file.__setitem__(
            "observations", h5py.ExternalLink(secret_file(places), "/observations")
        )
    ),
    "hdf5: an external link to a pipe": hdf5(
        lambda file, places: (
            os.mkfifo(places.secret),
            file.__setitem__("observations", h5py.ExternalLink(str(places.secret), "/a")),
        )
    ),
    "hdf5: a soft link": hdf5(
        lambda file, _: file.__setitem__("observations", h5py.SoftLink("/next_observations"))
    ),
    "hdf5: a soft link to itself": hdf5(
        lambda file, _: file.__setitem__("observations", h5py.SoftLink("/observations"))
    ),
    "hdf5: a dangling link": hdf5(
        lambda file, _: file.__setitem__("observations", h5py.SoftLink("/nowhere"))
    ),
    "hdf5: a virtual dataset": hdf5(virtual),
    "hdf5: values in another file": hdf5(external),
    "hdf5: another filter": replaced(FLAT["observations"], compression="lzf"),
    "hdf5: a chunk that is a bomb": hdf5(overfull_chunk),
    "hdf5: zeros that are a bomb": replaced(np.zeros((2**24, 2), dtype=np.float32), compression="gzip"),
    "hdf5: 8 TiB that are not there": shaped((TEBI // 8, 2)),
    "hdf5: 8 TiB of no chunks": shaped((TEBI // 8, 2), chunks=(64, 2)),
    "hdf5: one chunk of 2 GiB": shaped((64, 2), chunks=(2**28, 2), maxshape=(None, 2)),
    "hdf5: texts": replaced(np.array([b"a"] * 64, dtype="S1")),
    "hdf5: texts of any length": replaced(np.array(["a"] * 64, dtype=object), dtype=h5py.string_dtype()),
    "hdf5: tables": replaced(np.zeros(64, dtype=[("a", "f4")])),
    "hdf5: references": hdf5(lambda file, _: file.create_dataset("observations", (64,), h5py.ref_dtype)),
    "hdf5: complex numbers": replaced(np.zeros((64, 2), dtype=np.complex64)),
    "hdf5: no shape": hdf5(lambda file, _: file.__setitem__("observations", h5py.Empty("f4"))),
    "hdf5: a group": hdf5(lambda file, _: file.create_group("observations")),
    "hdf5: a group in itself": hdf5(lambda file, _: file.__setitem__("observations", file["/"])),
    "hdf5: a type": hdf5(lambda file, _: file.__setitem__("observations", np.dtype("f4"))),
    "hdf5: one episode 2,000 times": looped,
    "hdf5: a task of another world": ours(task=2**40),
    "hdf5: a negative step": ours(step=-1),
    "hdf5: a text for a step": ours(step="x"),
    "hdf5: parameters in brackets": ours(parameters="[" * 60_000),
    "hdf5: parameters that write to a terminal": ours(parameters=json.dumps({"a": "\x1b]0;owned\x07"})),
    "hdf5: an early flag": ours(early=True),
    "hdf5: an attribute of many": ours(format_version=np.ones(1000)),
    "hdf5: a heap without end": endless_heap(bytes(16)),
    "hdf5: a heap with an entry of 8 TiB": endless_heap(struct.pack("<HHIQ", 1, 1, 0, TEBI)),
    "hdf5: a heap with an entry that wraps": endless_heap(struct.pack("<HHIQ", 1, 1, 0, 2**64 - 16)),
    "hdf5: no HDF5": not_hdf5,
    "hdf5: a pipe": pipe_file,
} | {f"hdf5: cut at {share}": shortened(share) for share in (0.01, 0.3, 0.6, 0.99)}


def minari(change: Callable[[Path, Places], object]) -> Make:
    def make(places: Places) -> Path:
        data = places.folder / "data"
        data.mkdir(parents=True)
        (data / "metadata.json").write_text("{}")
        with h5py.File(data / "main_data.hdf5", "w") as file:
            for name, array in (
                ("observations", np.zeros((3, 1))),
                ("actions", np.zeros((2, 1))),
                ("rewards", np.zeros(2)),
                ("terminations", np.array([False, True])),
                ("truncations", np.zeros(2, dtype=bool)),
            ):
                file[f"episode_0/{name}"] = array
        change(data, places)
        return places.folder

    return make


def linked_content(data: Path, places: Places) -> None:
    (data / "main_data.hdf5").rename(places.secret)
    (data / "main_data.hdf5").symlink_to(places.secret)


def linked_data(data: Path, places: Places) -> None:
    data.rename(places.secret)
    data.symlink_to(places.secret)


MINARI: dict[str, Make] = {
    "minari: linked content": minari(linked_content),
    "minari: a linked folder": minari(linked_data),
    "minari: metadata in brackets": minari(
        lambda data, _: (data / "metadata.json").write_text("[" * 100_000)
    ),
    "minari: metadata that are a list": minari(lambda data, _: (data / "metadata.json").write_text("[]")),
    "minari: another storage": minari(
        lambda data, _: (data / "metadata.json").write_text('{"data_format": "arrow"}')
    ),
    "minari: no content": minari(lambda data, _: (data / "main_data.hdf5").unlink()),
    "minari: content cut": minari(lambda data, _: os.truncate(data / "main_data.hdf5", 900)),
}

CASES: dict[str, Make] = IDAQ | HDF5 | MINARI
FORMATS = {"npy": "idaq-npy", "hdf5": "hdf5", "minari": "minari", "parquet": "parquet"}
