"""Forged datasets of Minari for `tcmrl-data import`, each with one attack."""

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from tests.hostile.source import Make, Places


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


MINARI: dict[str, Make] = {
    "minari: metadata in brackets": minari(
        lambda data, _: (data / "metadata.json").write_text("[" * 100_000)
    ),
    "minari: another storage": minari(
        lambda data, _: (data / "metadata.json").write_text('{"data_format": "arrow"}')
    ),
    "minari: no content": minari(lambda data, _: (data / "main_data.hdf5").unlink()),
    "minari: content cut": minari(lambda data, _: os.truncate(data / "main_data.hdf5", 900)),
}
