"""Exports: what goes out comes back, other programs' rules find it."""

import json
import pickletools
import shutil
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tcmrl_data import FORMATS, Dataset, Trajectory, export_dataset, import_dataset, open_dataset
from tcmrl_data.foundation.disk import lock_file
from tcmrl_data.foundation.errors import LockedError, SelectionError, StoreError, TaskError
from tests.conftest import TASKS
from tests.test_adapters import terminated_early
from tests.test_interchange import assert_equal

READERS = {
    "hdf5": "hdf5",
    "idaq-npy": "idaq-npy",
    "minari": "minari",
    "parquet": "parquet",
    "robomimic": "hdf5",
}
FLAGLESS = ("idaq-npy",)
"""Formats that hold neither flags nor further arrays."""


def exported(dataset: Dataset, name: str, out: Path, **selection: Any) -> tuple[Path, ...]:
    """Exports a dataset, unless a package is missing."""
    for package in FORMATS.get(name).optional_packages:
        pytest.importorskip(package)
    return export_dataset(dataset, name, out, **selection).files


def sources(name: str, out: Path, files: Sequence[Path]) -> list[Path]:
    """What an import of an export is given."""
    if name == "idaq-npy":
        return [out]
    return [file.parents[1] for file in files if file.name == "main_data.hdf5"] or list(files)


@pytest.mark.parametrize("name", READERS)
def test_what_was_exported_comes_back(
    name: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Episodes of 20 to 15 steps, half of them terminated."""
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Dataset, "trajectories", terminated_early(Dataset.trajectories))
        files = exported(tiny, name, out, tasks=[0, 3], snapshots="steps>=100")
        expected = {key: tiny.trajectories(*key) for key in tiny.parts if key.task < 4 and key.step}
    tasks = out / "tasks.json" if name == "idaq-npy" else None
    report = import_dataset(READERS[name], sources(name, out, files), tmp_path / "back", tasks=tasks)
    back = open_dataset(tmp_path / "back")
    assert [(task.index, task.split, task.parameters) for task in back.tasks] == [
        (task.index, task.split, task.parameters) for task in tiny.tasks[:2]
    ]
    assert list(back.parts) == list(expected)
    for key, originals in expected.items():
        for found, original in zip(back.trajectories(*key), originals, strict=True):
            if name in FLAGLESS:
                for array in ("observations", "actions", "rewards"):
                    np.testing.assert_array_equal(getattr(found, array), getattr(original, array))
                assert (found.terminated.any(), found.truncated[-1]) == (False, True)
            else:
                assert_equal(found, original)
    assert bool(report.notes) == (name in FLAGLESS)


@pytest.mark.parametrize("name", READERS)
def test_an_imported_dataset_is_exported_too(name: str, imported: Dataset, tmp_path: Path) -> None:
    """It has no seed, no policies, no reference returns and no environment."""
    files = exported(imported, name, tmp_path / "out")
    report = import_dataset(READERS[name], sources(name, tmp_path / "out", files), tmp_path / "back")
    assert (report.tasks, report.episodes, report.steps) == (2, 12, 240)


@pytest.fixture(scope="module")
def imported(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("imported")
    files = export_dataset(tiny, "hdf5", folder / "hdf5", tasks=[0, 3], snapshots="last").files
    import_dataset("hdf5", files, folder / "data")
    return open_dataset(folder / "data")


def test_files_are_found_and_read_by_the_rules_of_the_published_loaders(
    tiny: Dataset, tmp_path: Path
) -> None:
    """`init_buffer` of FOCAL, IDAQ and TCMRL (rlkit/core/rl_algorithm.py): names, columns, float64."""
    export_dataset(tiny, "idaq-npy", tmp_path / "data")
    in_order = [task.index for task in (*tiny.train_tasks, *tiny.test_tasks)]
    assert json.loads((tmp_path / "data/task_numbers.json").read_text()) == in_order
    for step in (100, 150):  # `train_epoch`
        for place, task in enumerate(in_order):  # `range(n)`, the first for training
            expected = tiny.trajectories(task, step)
            for number in range(6):  # `n_trj`
                (file,) = (tmp_path / "data").glob(f"goal_idx{place}/trj_evalsample{number}_step{step}.npy")
                rows = np.load(file, allow_pickle=True)
                assert rows.shape == (20, 4)
                buffers = [np.zeros((20, 2)), np.zeros((20, 2)), np.zeros((20, 1)), np.zeros((20, 2))]
                for index in range(len(rows)):
                    for buffer, column in zip(buffers, range(4), strict=True):
                        buffer[index] = rows[:, column][index]
                original = expected[number]
                np.testing.assert_array_equal(buffers[0], original.observations[:-1])
                np.testing.assert_array_equal(buffers[1], original.actions)
                np.testing.assert_array_equal(buffers[2][:, 0], original.rewards)
                np.testing.assert_array_equal(buffers[3], original.observations[1:])
    assert len(list((tmp_path / "data").glob("goal_idx*"))) == len(TASKS)


def test_pickled_rows_name_what_every_numpy_has(tiny: Dataset, tmp_path: Path) -> None:
    """NumPy 2 itself would name `numpy._core`, which the NumPy of the published code lacks."""
    export_dataset(tiny, "idaq-npy", tmp_path / "data", tasks=[0], snapshots="last")
    content = (tmp_path / "data/goal_idx0/trj_evalsample0_step150.npy").read_bytes()
    operations = list(pickletools.genops(content[128:]))
    names = {argument for operation, argument, _ in operations if operation.name == "GLOBAL"}
    assert names == {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype"}
    assert max(operation.proto for operation, _, _ in operations) <= 3


def test_robomimics_layout_is_complete(tiny: Dataset, tmp_path: Path) -> None:
    """Every group, dataset and attribute of https://robomimic.github.io/docs/datasets/overview.html."""
    export_dataset(tiny, "robomimic", tmp_path / "out", tasks=[3])
    expected = tiny.select(tasks=[3]).trajectories(3)
    with h5py.File(tmp_path / "out/task_00003.hdf5") as file:
        data = file["data"]
        assert data.attrs["total"] == 360
        environment = json.loads(data.attrs["env_args"])
        assert (environment["env_name"], environment["type"]) == ("point-robot", 2)
        assert set(data) == {f"demo_{number}" for number in range(18)}
        for number, original in enumerate(expected):
            demonstration = data[f"demo_{number}"]
            assert demonstration.attrs["num_samples"] == len(original)
            np.testing.assert_array_equal(demonstration["obs/flat"], original.observations[:-1])
            np.testing.assert_array_equal(demonstration["next_obs/flat"], original.observations[1:])
            np.testing.assert_array_equal(demonstration["actions"], original.actions)
            np.testing.assert_array_equal(demonstration["rewards"], original.rewards)
            np.testing.assert_array_equal(demonstration["dones"], original.terminated.astype(int))
        masks = {name: [member.decode() for member in mask[:]] for name, mask in file["mask"].items()}
    names = [f"demo_{number}" for number in range(18)]
    assert masks == {
        "test": names,
        "step_0": names[:6],
        "step_100": names[6:12],
        "step_150": names[12:],
    }


def test_pyarrow_reads_one_table_of_all_files(tiny: Dataset, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    files = export_dataset(tiny, "parquet", tmp_path / "out", split="train").files
    table = parquet.read_table(tmp_path / "out")
    assert table.num_rows == 4 * 360
    one = parquet.read_table(files[1])
    expected = tiny.select(tasks=[40]).trajectories(40)
    for column, rows in {
        "observation": np.concatenate([episode.observations[:-1] for episode in expected]),
        "next_observation": np.concatenate([episode.observations[1:] for episode in expected]),
        "action": np.concatenate([episode.actions for episode in expected]),
        "reward": np.concatenate([episode.rewards for episode in expected]),
        "truncated": np.concatenate([episode.truncated for episode in expected]),
        "episode": np.repeat(np.arange(18), 20),
        "time": np.tile(np.arange(20), 18),
        "step": np.repeat([0, 100, 150], 120),
    }.items():
        np.testing.assert_array_equal(np.array(one.column(column).to_pylist(), rows.dtype), rows)
    assert one.column("run").unique().to_pylist() == ["main"]
    assert table.column("split").unique().to_pylist() == ["train"]
    (goal,) = {tuple(goal) for goal in one.column("parameter_goal").to_pylist()}
    assert list(goal) == tiny.task(40).parameters["goal"]
    assert json.loads(one.schema.metadata[b"tcmrl"])["split"] == "train"


@pytest.mark.parametrize(
    ("name", "episode_bytes"), [("hdf5", 1_500), ("minari", 3_000), ("robomimic", 4_000)]
)
def test_hdf5_keeps_short_episodes_small(
    name: str, episode_bytes: int, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Episodes of 20 steps have 540 bytes, in files of 1,000 and more a task."""
    original = Dataset.trajectories
    monkeypatch.setattr(Dataset, "trajectories", lambda self, *key: original(self, *key) * 50)
    files = exported(tiny, name, tmp_path / "out", tasks=[0], snapshots="last")
    assert sum(file.stat().st_size for file in files) < 300 * episode_bytes


@pytest.mark.parametrize("name", ["hdf5", "minari", "robomimic"])
def test_hdf5_compresses_long_episodes(
    name: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zeros = np.zeros(4_000, np.float32)
    flags = np.arange(4_000) == 3_999
    episode = Trajectory(
        np.zeros((4_001, 2), np.float32), np.tile(zeros, (2, 1)).T, zeros, flags, np.zeros(4_000, bool)
    )
    monkeypatch.setattr(Dataset, "trajectories", lambda self, *key: [episode])
    files = exported(tiny, name, tmp_path / "out", tasks=[0], snapshots="last")
    assert sum(file.stat().st_size for file in files) < 40_000 < episode.observations.nbytes * 2


@pytest.mark.parametrize("name", READERS)
def test_one_part_at_a_time_is_in_memory(
    name: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Episodes(list[Trajectory]):
        """A list that can be watched."""

    alive: weakref.WeakSet[Episodes] = weakref.WeakSet()
    most = 0
    original = Dataset.trajectories

    def watched(self: Dataset, *key: Any) -> Episodes:
        nonlocal most
        made = Episodes(original(self, *key))
        alive.add(made)
        most = max(most, len(alive))
        return made

    Episodes.__hash__ = lambda self: id(self)  # type: ignore[method-assign]
    monkeypatch.setattr(Dataset, "trajectories", watched)
    exported(tiny, name, tmp_path / "out")
    assert most <= 2  # the one before, until the next is bound to its name


def test_an_export_removes_what_a_killed_one_left_and_excludes_a_running_one(
    tiny: Dataset, tmp_path: Path
) -> None:
    staged = tmp_path / ".out.partial"
    (staged / "files").mkdir(parents=True)
    (staged / "files/task_00000.hdf5").touch()
    with (
        lock_file(staged / "lock", "the export"),
        pytest.raises(LockedError, match=r"the export .*out is being written by process"),
    ):
        export_dataset(tiny, "hdf5", tmp_path / "out", snapshots="last")
    files = export_dataset(tiny, "hdf5", tmp_path / "out", snapshots="last", tasks=[3]).files
    assert [file.name for file in files] == ["task_00003.hdf5"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("is_link", [False, True])
def test_what_lies_where_exports_are_staged_is_left_alone(
    is_link: bool, tiny: Dataset, tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes").touch()
    staged = tmp_path / ".out.partial"
    if is_link:
        staged.symlink_to(mine)
    else:
        shutil.copytree(mine, staged)
    with pytest.raises(
        StoreError, match=r"\.out\.partial is in the way, where exports are staged; remove it"
    ):
        export_dataset(tiny, "hdf5", tmp_path / "out")
    assert (staged / "notes").exists() and not (tmp_path / "out").exists()


def test_a_dry_run_checks_everything_and_writes_nothing(tiny: Dataset, tmp_path: Path) -> None:
    report = export_dataset(tiny.folder, "robomimic", tmp_path / "out", split="test", dry_run=True)
    assert (report.tasks, report.parts, report.episodes, report.steps) == (1, 3, 18, 360)
    assert (report.files, list(tmp_path.iterdir())) == ((), [])
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="not empty"):
        export_dataset(tiny, "hdf5", tmp_path, dry_run=True)


@pytest.mark.parametrize(
    ("selection", "error", "expected"),
    [
        ({"tier": "best"}, SelectionError, "best"),
        ({"tier": "expert", "snapshots": "last"}, SelectionError, "exclude each other"),
        ({"tasks": [1]}, TaskError, "no task 1"),
        ({"tasks": [0], "split": "test"}, SelectionError, "no test tasks"),
    ],
)
def test_a_selection_that_cannot_be_met_is_refused(
    selection: dict[str, Any], error: type[Exception], expected: str, tiny: Dataset, tmp_path: Path
) -> None:
    with pytest.raises(error, match=expected):
        export_dataset(tiny, "hdf5", tmp_path / "out", **selection)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", [name for name in READERS if name != "hdf5"])
def test_an_episode_without_steps_is_refused(
    name: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = np.zeros(0, dtype=bool)
    empty = Trajectory(np.zeros((1, 2)), np.zeros((0, 2)), np.zeros(0), none, none)
    monkeypatch.setattr(Dataset, "trajectories", lambda self, *key: [empty])
    with pytest.raises(StoreError, match=r"0000150.zip: episode 0 has no steps.*hdf5"):
        exported(tiny, name, tmp_path / "out", snapshots="last")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda columns: columns.pop("episode"), "no column episode"),
        (lambda columns: columns.update(episode=np.zeros(4)), "episode and step are no integers"),
        (lambda columns: columns.update(reward=np.full(4, np.nan, np.float32)), "not finite"),
        (lambda columns: columns.update(terminated=np.ones(4, bool)), "before the episode's last step"),
        (lambda columns: columns.update(observation=list(np.zeros((4, 2)))), "does not begin"),
        (lambda columns: columns.update(action=np.zeros(4)), "column action has no lists"),
        (lambda columns: columns.update(action=[[0.0], [0.0, 1.0], [0.0, 1.0], [0.0]]), "action has"),
        (lambda columns: columns.update(reward=["much"] * 4), "no column reward of numbers"),
        (lambda columns: columns.update(reward=[None, 1.0, 2.0, 3.0]), "reward lacks values"),
    ],
)
def test_a_table_that_is_no_row_a_transition_is_refused(
    change: Callable[[dict[str, Any]], object], expected: str, tmp_path: Path
) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = table()
    change(columns)
    parquet.write_table(pyarrow.table(columns), tmp_path / "t.parquet")
    with pytest.raises(StoreError, match=expected) as refused:
        import_dataset("parquet", [tmp_path / "t.parquet"], tmp_path / "out")
    assert str(tmp_path / "t.parquet") in str(refused.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("codec", ["none", "snappy", "gzip", "zstd"])
def test_a_table_of_another_program_is_read(codec: str, tmp_path: Path) -> None:
    """Doubles and lists without a fixed length, no step and no task."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table(table()), tmp_path / "t.parquet", compression=codec)
    report = import_dataset("parquet", [tmp_path / "t.parquet"], tmp_path / "out", task=7)
    first, second = open_dataset(tmp_path / "out").trajectories(7, 0)
    assert (len(first), len(second), report.notes) == (3, 1, ())
    np.testing.assert_array_equal(first.observations, [[0, 0], [1, 1], [2, 2], [3, 3]])
    assert (first.terminated[-1], second.truncated[-1]) == (True, True)
    assert list(first.extras) == ["effort"]


def table() -> dict[str, Any]:
    """Two episodes, of three steps and of one."""
    before = np.array([[0, 0], [1, 1], [2, 2], [5, 5]], dtype=np.float64)
    return {
        "episode": np.array([4, 4, 4, 2]),
        "observation": list(before),
        "action": list(np.full((4, 1), 0.5)),
        "reward": np.arange(4, dtype=np.float64),
        "next_observation": list(before + 1),
        "terminated": np.array([False, False, True, False]),
        "truncated": np.array([False, False, False, True]),
        "effort": np.arange(4),
        "note": ["a"] * 4,
    }
