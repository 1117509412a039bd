import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tcmrl_data import Dataset, Trajectory, export_dataset
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import FORMATS
from tcmrl_data.interchange.reader import EPISODE_ARRAYS
from tests.conftest import TASKS
from tests.strategies import trajectories


def read_groups(path: Path) -> list[Trajectory]:
    """The episodes of a file, as the documentation reads them."""
    with h5py.File(path) as file:
        index = {name: array[:] for name, array in file["episodes"].items()}
        flat = {name: array[:] for name, array in file.items() if name != "episodes"}
    names = ("actions", "rewards", "terminals", "timeouts")
    extras = flat.keys() - {*names, "observations", "next_observations", "episode", "step"}
    episodes = []
    for stop, length, final in zip(
        index["length"].cumsum(), index["length"], index["final_observation"], strict=True
    ):
        rows = slice(stop - length, stop)
        observations = np.concatenate([flat["observations"][rows], [final]])
        arrays = (flat[name][rows] for name in names)
        episodes.append(Trajectory(observations, *arrays, {name: flat[name][rows] for name in extras}))
    return episodes


def assert_equal(left: Trajectory, right: Trajectory) -> None:
    for name in EPISODE_ARRAYS:
        one, other = getattr(left, name), getattr(right, name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert left.extras.keys() == right.extras.keys()
    for name, array in left.extras.items():
        assert array.dtype == right.extras[name].dtype
        np.testing.assert_array_equal(array, right.extras[name])


@pytest.mark.parametrize("name", FORMATS.names())
class TestEveryFormat:
    """The guarantees that `tcmrl-data export` needs from every format."""

    @pytest.fixture(autouse=True)
    def library(self, name: str) -> None:
        for package in FORMATS.get(name).optional_packages:
            pytest.importorskip(package)

    def test_reports_progress_and_returns_existing_files(
        self, name: str, tiny: Dataset, tmp_path: Path
    ) -> None:
        seen: list[tuple[int, int]] = []
        report = export_dataset(
            *(tiny, name, tmp_path / "out"),
            snapshots="last",
            progress=lambda done, total: seen.append((done, total)),
        )
        assert seen == [(done, 5) for done in range(1, 6)]
        assert (report.tasks, report.parts, report.episodes, report.steps) == (5, 5, 30, 600)
        assert report.files == tuple(sorted(path for path in (tmp_path / "out").rglob("*") if path.is_file()))
        assert [path.name for path in tmp_path.iterdir()] == ["out"]

    def test_a_failure_leaves_nothing(
        self, name: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        original = Dataset.trajectories

        def fail_late(self: Dataset, task: int, step: int, run: str = "main") -> list[Trajectory]:
            if task == TASKS[-1]:
                raise StoreError("damaged")
            return original(self, task, step, run)

        monkeypatch.setattr(Dataset, "trajectories", fail_late)
        with pytest.raises(StoreError, match="damaged"):
            export_dataset(tiny, name, tmp_path / "out")
        assert list(tmp_path.iterdir()) == []


def test_hdf5_flat_arrays_are_the_transitions(tiny: Dataset, exported_hdf5: Path) -> None:
    episodes = tiny.select(tasks=[40]).trajectories(40)
    with h5py.File(exported_hdf5 / "task_00040.hdf5") as file:
        np.testing.assert_array_equal(
            file["observations"][:], np.concatenate([episode.observations[:-1] for episode in episodes])
        )
        np.testing.assert_array_equal(
            file["next_observations"][:], np.concatenate([episode.observations[1:] for episode in episodes])
        )
        for flat, name in {
            "actions": "actions",
            "rewards": "rewards",
            "terminals": "terminated",
            "timeouts": "truncated",
        }.items():
            np.testing.assert_array_equal(file[flat][:], np.concatenate([getattr(e, name) for e in episodes]))
            assert file[flat].dtype == getattr(episodes[0], name).dtype
        np.testing.assert_array_equal(file["episode"][:], np.repeat(np.arange(18), 20))
        np.testing.assert_array_equal(file["step"][:], np.repeat([0, 100, 150], 120))
        assert not file["terminals"][:].any()
        assert file["timeouts"][:].sum() == 18


def test_hdf5_says_where_it_comes_from(tiny: Dataset, exported_hdf5: Path) -> None:
    for task in tiny.tasks:
        with h5py.File(exported_hdf5 / f"task_{task.index:05d}.hdf5") as file:
            attributes = dict(file.attrs)
        assert json.loads(attributes["parameters"]) == dict(task.parameters)
        assert (attributes["task"], attributes["split"]) == (task.index, task.split)
        assert (attributes["environment"], attributes["seed"]) == ("point-robot", 0)
        assert attributes["dataset_root"] == tiny.manifest.root
        assert attributes["snapshots"].tolist() == [0, 100, 150]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(trajectories(), min_size=1, max_size=4))
def test_hdf5_round_trip_of_any_episodes(
    tiny: Dataset, tmp_path_factory: pytest.TempPathFactory, episodes: list[Trajectory]
) -> None:
    """Lengths 0 and 1, terminations and success flags; every part has the same episodes."""
    out = tmp_path_factory.mktemp("round-trip") / "flat"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dataset, "trajectories", lambda self, *key: episodes)
        export_dataset(tiny, "hdf5", out, snapshots="steps>=100")
    for left, right in zip(episodes * 2, read_groups(out / "task_00000.hdf5"), strict=True):
        assert_equal(left, right)
    with h5py.File(out / "task_00000.hdf5") as file:
        assert len(file["success"]) == len(file["rewards"]) == 2 * sum(map(len, episodes))
