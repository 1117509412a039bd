"""Minari datasets that Minari's own collector wrote; `test_exports.py` has those that were exported here."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tcmrl_data import import_dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.errors import StoreError

minari = pytest.importorskip("minari")
LENGTHS = (4, 3)


def collected(folder: Path, monkeypatch: pytest.MonkeyPatch, *, nested: bool = False) -> Path:
    """A dataset with a dictionary of observations and with infos, written by Minari alone."""
    from gymnasium.spaces import Box, Dict
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    wide, narrow = Box(-9, 9, (2,), np.float64), Box(-9, 9, (1,), np.float64)
    inner: Any = {"b": wide, "a": Dict({"deep": narrow}) if nested else narrow}
    buffers = []
    for length in LENGTHS:
        rows = np.arange(length + 1, dtype=np.float64)[:, None]
        flags = np.zeros((2, length), dtype=bool)
        flags[length % 2, -1] = True
        buffers.append(
            EpisodeBuffer(
                observations={"b": np.hstack([rows, rows]), "a": {"deep": rows} if nested else -rows},
                actions=np.full((length, 1), 0.5),
                rewards=np.ones(length),
                terminations=flags[0],
                truncations=flags[1],
                infos={"success": np.arange(length + 1) > 1, "position": np.hstack([rows, rows])},
            )
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # author, link and environment are unknown
        minari.create_dataset_from_buffers(
            "made/here-v0",
            buffers,
            observation_space=Dict(inner),
            action_space=Box(-1, 1, (1,), np.float64),
        )
    return folder / "made" / "here-v0"


def test_a_dataset_of_minari_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = collected(tmp_path / "minari", monkeypatch)
    import_dataset("minari", [path], tmp_path / "data", task=3)
    found = open_dataset(tmp_path / "data")
    first, second = found.trajectories(3, 0)
    np.testing.assert_array_equal(second.observations, [[0, 0, 0], [-1, 1, 1], [-2, 2, 2], [-3, 3, 3]])
    assert [first.terminated[-1], first.truncated[-1]] == [True, False]
    assert [second.terminated[-1], second.truncated[-1]] == [False, True]
    assert {name: list(values) for name, values in second.extras.items()} == {"success": [False, True, True]}
    assert found.part(3, 0).statistics.success_rate == 1.0
    assert verify_dataset(found.folder, level="deep").findings == ()
    monkeypatch.chdir(path)
    (tmp_path / "linked").symlink_to(path)
    import_dataset("minari", [Path("../here-v0")], tmp_path / "a", options={"observation_keys": "a"})
    assert open_dataset(tmp_path / "a").environment.observation_dim == 1
    (path / "data").rename(tmp_path / "blobs")
    (path / "data").mkdir()
    for file in (tmp_path / "blobs").iterdir():
        (path / "data" / file.name).symlink_to(file)
    linked = import_dataset("minari", [tmp_path / "linked"], tmp_path / "links", task=3)
    assert linked.episodes == 2


def test_what_is_no_flat_minari_dataset_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = collected(tmp_path / "minari", monkeypatch, nested=True)
    with pytest.raises(StoreError, match="observations/a is no dataset"):
        import_dataset("minari", [path], tmp_path / "data")
    metadata = path / "data" / "metadata.json"
    metadata.write_text(metadata.read_text().replace('"hdf5"', '"arrow"'))
    with pytest.raises(StoreError, match="data_format is 'arrow', only hdf5 is read"):
        import_dataset("minari", [path], tmp_path / "data")
    with pytest.raises(StoreError, match="name the folder of a Minari dataset"):
        import_dataset("minari", [tmp_path], tmp_path / "data")
    assert not (tmp_path / "data").exists()
