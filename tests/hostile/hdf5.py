"""Forged HDF5 files for `tcmrl-data import`, each with one attack."""

import json
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.hostile.source import TEBI, Make, Places

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
    """robomimic's layout, in which 2,000 demonstrations are one: links to the same group."""
    places.folder.mkdir()
    path = places.folder / "demonstrations.hdf5"
    with h5py.File(path, "w") as file:
        first = file.create_group("data/demo_0")
        arrays = {
            "obs/flat": np.zeros((20_000, 2), dtype=np.float32),
            "actions": np.zeros((20_000, 1), dtype=np.float32),
            "rewards": np.zeros(20_000, dtype=np.float32),
            "dones": np.zeros(20_000, dtype=np.int64),
        }
        for name, array in arrays.items():
            first.create_dataset(name, data=array, compression="gzip")
        for number in range(1, 2_000):
            file[f"data/demo_{number}"] = first
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
            file.attrs.update(plain | {name: value for name, value in attributes.items() if name in plain})
            ended = np.array([False, True])
            for name, array in (
                ("observations", np.zeros((2, 1), dtype=np.float32)),
                ("actions", np.zeros((2, 1), dtype=np.float32)),
                ("rewards", np.zeros(2, dtype=np.float32)),
                ("terminals", ended),
                ("timeouts", ~ended if attributes.get("early") else ended),
                ("episodes/length", attributes.get("length", np.array([2]))),
                ("episodes/step", np.array(attributes.get("step", [0]))),
                ("episodes/final_observation", attributes.get("final", np.zeros((1, 1), np.float32))),
            ):
                file[name] = array
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
    "hdf5: a soft link": hdf5(
        lambda file, _: file.__setitem__("observations", h5py.SoftLink("/next_observations"))
    ),
    "hdf5: a soft link to itself": hdf5(
        lambda file, _: file.__setitem__("observations", h5py.SoftLink("/observations"))
    ),
    "hdf5: a virtual dataset": hdf5(virtual),
    "hdf5: values in another file": hdf5(external),
    "hdf5: another filter": replaced(FLAT["observations"], compression="lzf"),
    "hdf5: a chunk that is a bomb": hdf5(overfull_chunk),
    "hdf5: zeros that are a bomb": replaced(np.zeros((2**24, 2), dtype=np.float32), compression="gzip"),
    "hdf5: 8 TiB that are not there": shaped((TEBI // 8, 2)),
    "hdf5: one chunk of 2 GiB": shaped((64, 2), chunks=(2**28, 2), maxshape=(None, 2)),
    "hdf5: texts of any length": replaced(np.array(["a"] * 64, dtype=object), dtype=h5py.string_dtype()),
    "hdf5: references": hdf5(lambda file, _: file.create_dataset("observations", (64,), h5py.ref_dtype)),
    "hdf5: no shape": hdf5(lambda file, _: file.__setitem__("observations", h5py.Empty("f4"))),
    "hdf5: one episode 2,000 times": looped,
    "hdf5: a task of another world": ours(task=2**40),
    "hdf5: a negative step": ours(step=[-1]),
    "hdf5: parameters in brackets": ours(parameters="[" * 60_000),
    "hdf5: parameters that write to a terminal": ours(parameters=json.dumps({"a": "\x1b]0;owned\x07"})),
    "hdf5: an early flag": ours(early=True),
    "hdf5: episodes beyond the rows": ours(length=np.array([2**62])),
    "hdf5: episodes that go back": ours(length=np.array([4, -2]), step=[0, 0], final=np.zeros((2, 1))),
    "hdf5: final observations of another shape": ours(final=np.zeros((1, 3))),
    "hdf5: an attribute of many": ours(format_version=np.ones(1000)),
    "hdf5: no HDF5": not_hdf5,
    "hdf5: a pipe": pipe_file,
} | {f"hdf5: cut at {share}": shortened(share) for share in (0.01, 0.3, 0.6, 0.99)}
