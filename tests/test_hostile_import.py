"""A hostile file cannot run code, lead elsewhere, block, take memory or publish anything."""

import importlib.util
import os
from pathlib import Path

import pytest

from tcmrl_data import TcmrlError, import_dataset
from tests.hostile.bounds import bounded
from tests.hostile.hdf5 import HDF5, hdf5
from tests.hostile.minari import MINARI, minari
from tests.hostile.npy import IDAQ
from tests.hostile.parquet import PARQUET, columns, written
from tests.hostile.source import Places
from tests.made_up import trajectory
from tests.test_import_idaq import saved

MEMORY_RATIO = 2
CASES = IDAQ | HDF5 | MINARI | (PARQUET if importlib.util.find_spec("pyarrow") else {})
FORMATS = {"npy": "idaq-npy", "hdf5": "hdf5", "minari": "minari", "parquet": "parquet"}


@pytest.fixture
def places(tmp_path: Path) -> Places:
    (tmp_path / "outside").mkdir()
    return Places(tmp_path / "source", tmp_path / "outside" / "secret", tmp_path / "ran")


@pytest.fixture(scope="module", autouse=True)
def _loaded(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The memory of imports is not counted."""
    folder = tmp_path_factory.mktemp("sound")
    places = Places(folder / "flat", folder / "secret", folder / "ran")
    import_dataset("hdf5", [hdf5(lambda file, _: None, without="")(places)], folder / "one")
    import_dataset(
        "minari", [minari(lambda data, _: None)(Places(folder / "m", *places[1:]))], folder / "two"
    )
    saved(folder / "d/goal_idx0/trj_evalsample0_step0.npy", trajectory(5, seed=0))
    import_dataset("idaq-npy", [folder / "d"], folder / "three")
    if CASES.keys() >= PARQUET.keys():
        (folder / "sound.parquet").write_bytes(written(columns()))
        import_dataset("parquet", [folder / "sound.parquet"], folder / "four")


def source_bytes(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*"))


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=() if position % 4 == 0 else pytest.mark.check)
        for position, case in enumerate(CASES)
    ],
)
def test_a_hostile_file_is_refused(case: str, places: Places, tmp_path: Path) -> None:
    path = CASES[case](places)
    before = sorted(tmp_path.rglob("*"))
    with bounded(source_bytes(places.folder), ratio=MEMORY_RATIO), pytest.raises(TcmrlError) as refused:
        import_dataset(FORMATS[case.partition(":")[0]], [path], tmp_path / "out")
    message = str(refused.value)
    assert str(places.folder) in message
    assert len(message.splitlines()) == 1
    assert message.isprintable()
    assert len(message) < 800
    assert not places.marker.exists(), "code of the file ran"
    assert sorted(tmp_path.rglob("*")) == before
    assert not os.path.lexists(tmp_path / "out")
