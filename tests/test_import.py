"""Import: what foreign files hold becomes a dataset that opens, samples, trains and verifies."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

import tcmrl_algo
import tcmrl_data
from tcmrl_data import Dataset, TcmrlError, import_dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.errors import BuildError, SimulationError, SnapshotError, StoreError, TaskError
from tcmrl_data.store.tables import TASKS as TASK_TABLE
from tcmrl_data.verification.repair import repair_dataset
from tests.conftest import TASKS

ENTRY = '{"index": 0, "split": "train", "parameters": {}}'
NEVER = np.zeros(6, dtype=bool)


@pytest.fixture(scope="module")
def exported(exported_hdf5: Path) -> list[Path]:
    return sorted(exported_hdf5.iterdir())


def rows(**changed: Any) -> dict[str, np.ndarray]:
    """Six rows of two episodes, as D4RL has them: the first ends in a terminal state, the second by time."""
    observations = np.arange(12, dtype=np.float32).reshape(6, 2)
    following = observations + 2
    following[2] = 99
    arrays = {
        "observations": observations,
        "next_observations": following,
        "actions": np.linspace(-1, 1, 6, dtype=np.float32)[:, None],
        "rewards": np.arange(6, dtype=np.float32),
        "terminals": np.array([0, 0, 1, 0, 0, 0], dtype=bool),
        "timeouts": np.array([0, 0, 0, 0, 0, 1], dtype=bool),
    }
    return {name: array for name, array in (arrays | changed).items() if array is not None}


def written(path: Path, arrays: dict[str, np.ndarray], **options: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, **options)
    return path


def imported(paths: Sequence[Path], out: Path, **options: Any) -> Dataset:
    import_dataset("hdf5", paths, out, **options)
    assert verify_dataset(out, level="deep", replay=2).findings == ()
    return open_dataset(out)


def test_what_a_file_does_not_say_stays_open(exported: list[Path], tmp_path: Path) -> None:
    found = imported(exported, tmp_path / "data", licence="CC-BY-4.0", url="https://example.org", label="x")
    (made,) = found.manifest.runs
    assert (made.kind, made.seed, made.steps, found.manifest.label) == ("imported", None, None, "x")
    assert made.origin is not None
    assert (made.origin["licence"], made.origin["url"]) == ("CC-BY-4.0", "https://example.org")
    assert [name for name, _ in made.origin["files"]] == [path.name for path in exported]
    identity = found.part(0, 100).identity
    assert (identity.seed, identity.policy) == (None, None)
    assert found.references(0).uniform is None
    with pytest.raises(SnapshotError, match="holds no policy"):
        found.snapshot(0, 100)


def test_a_foreign_environment_has_sizes_and_no_simulation(exported: list[Path], tmp_path: Path) -> None:
    found = imported(exported, tmp_path / "data")
    environment = found.environment
    assert (found.name, environment.observation_dim, environment.action_dim) == ("foreign", 2, 2)
    assert environment.settings.horizon == 20
    with pytest.raises(SimulationError, match="--environment NAME"):
        environment.lanes([{}])
    assert "foreign" not in tcmrl_data.ENVIRONMENTS.members()


def test_a_method_without_contexts_trains_on_imported_data(exported: list[Path], tmp_path: Path) -> None:
    found = imported(exported, tmp_path / "data")
    config = tcmrl_algo.resolve_for(
        found, profile="paper", algorithm="no_context", overrides=["run.steps=3", "batch.tasks=2"]
    )
    report = tcmrl_algo.train_run(found, tmp_path / "run", config=config, profile="paper")
    assert report.step == 3


def test_data_of_one_of_our_environments_are_bound_to_it(
    exported: list[Path], tiny: Dataset, tmp_path: Path
) -> None:
    found = imported(exported, tmp_path / "data", environment="point-robot")
    assert found.name == "point-robot"
    assert found.environment.lanes([found.tasks[0].parameters]).num_lanes == 1
    with pytest.raises(StoreError, match=r"\(2, 2, 20\), those of half-cheetah-vel \(17, 6, 200\)"):
        import_dataset("hdf5", exported, tmp_path / "other", environment="half-cheetah-vel")
    assert not (tmp_path / "other").exists()


def test_flat_arrays_end_where_a_flag_is_set(tmp_path: Path) -> None:
    found = imported([written(tmp_path / "flat.hdf5", rows())], tmp_path / "data")
    first, second = found.trajectories(0, 0)
    np.testing.assert_array_equal(first.observations, [[0, 1], [2, 3], [4, 5], [99, 99]])
    np.testing.assert_array_equal(second.observations, [[6, 7], [8, 9], [10, 11], [12, 13]])
    assert [list(first.terminated), list(first.truncated)] == [[False, False, True], [False] * 3]
    assert [list(second.terminated), list(second.truncated)] == [[False] * 3, [False, False, True]]
    assert [first.undiscounted_return, second.undiscounted_return] == [3.0, 12.0]


def test_an_episode_ends_where_the_next_row_does_not_follow(tmp_path: Path) -> None:
    arrays = rows(timeouts=NEVER)
    arrays["next_observations"][4] = -1
    report = import_dataset("hdf5", [written(tmp_path / "flat.hdf5", arrays)], tmp_path / "data")
    assert [len(one) for one in open_dataset(tmp_path / "data").trajectories(0, 0)] == [3, 2, 1]
    assert report.notes == (
        "flat.hdf5: 1 episodes end where next_observations are not the next row's observations",
        "flat.hdf5: 2 episodes end without a flag and are marked as truncated, not terminated",
    )


def test_without_next_observations_the_last_step_is_left_out(tmp_path: Path) -> None:
    file = written(tmp_path / "flat.hdf5", rows(next_observations=None))
    report = import_dataset("hdf5", [file], tmp_path / "data")
    first, second = open_dataset(tmp_path / "data").trajectories(0, 0)
    np.testing.assert_array_equal(first.observations, [[0, 1], [2, 3], [4, 5]])
    assert [len(first), len(second)] == [2, 2]
    assert first.truncated[-1]
    assert "2 episodes lose their last step" in report.notes[0]


def demonstrations(path: Path, *, with_next: bool = True) -> Path:
    with h5py.File(path, "w") as file:
        for number in (0, 2, 10):
            group = file.create_group(f"data/demo_{number}")
            steps = np.full((3, 1), number, dtype=np.float64) + np.arange(3)[:, None]
            kinds = {"obs": steps, "next_obs": steps + 1} if with_next else {"obs": steps}
            for kind, column in kinds.items():
                group[f"{kind}/eef"], group[f"{kind}/joints"] = column, np.hstack([column, column])
                group[f"{kind}/image"] = np.zeros((3, 4, 4, 3), dtype=np.uint8)
            group["actions"], group["rewards"] = np.zeros((3, 2)), np.array([0.0, 0.0, 1.0])
            group["dones"] = np.array([0, 1, number == 2], dtype=np.int64)
    return path


def test_robomimic_demonstrations(tmp_path: Path) -> None:
    found = imported([demonstrations(tmp_path / "demo.hdf5")], tmp_path / "data")
    episodes = found.trajectories(0, 0)
    np.testing.assert_array_equal(episodes[1].observations, np.repeat([[2.0], [3], [4], [5]], 3, axis=1))
    assert [bool(one.terminated[-1]) for one in episodes] == [False, True, False]
    assert episodes[2].observations[0, 0] == 10
    eef = imported(
        [demonstrations(tmp_path / "eef.hdf5", with_next=False)],
        tmp_path / "eef",
        options={"observation_keys": "eef"},
    )
    assert [one.observations.shape for one in eef.trajectories(0, 0)] == [(3, 1)] * 3


def test_files_without_task_numbers_are_counted(tmp_path: Path) -> None:
    files = [written(tmp_path / f"{number}.hdf5", rows()) for number in range(3)]
    (tmp_path / "tasks.json").write_text('[{"index": 8, "split": "test", "parameters": {"goal": [1.0]}}]')
    found = imported(files, tmp_path / "data", task=7, tasks=tmp_path / "tasks.json")
    assert [(task.index, task.split, task.parameters) for task in found.tasks] == [
        (7, "train", {}),
        (8, "test", {"goal": [1.0]}),
        (9, "train", {}),
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": np.full((6, 1), 1.5)}, r"flat.hdf5: actions reach 1.5, beyond \[-1, 1\]"),
        (
            {"rewards": np.array([0, 0, np.nan, 0, 0, 0])},
            "flat.hdf5: rewards hold a value that is not finite",
        ),
        ({"rewards": np.full(6, 1e300)}, "rewards hold a value that is not finite as float32"),
        ({"rewards": np.zeros(5)}, "flat.hdf5: rewards has 5 rows, observations have 6"),
        ({"terminals": np.zeros((6, 2))}, r"flat.hdf5: terminals: has shape \(6, 2\)"),
        ({"actions": None}, "is of no known layout .*actions missing"),
        ({"observations": np.zeros((6, 0)), "next_observations": None}, "1 is the least"),
    ],
)
def test_what_forms_no_episodes_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    file = written(tmp_path / "flat.hdf5", rows(**changes))
    with pytest.raises(StoreError, match=message):
        import_dataset("hdf5", [file], tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_a_file_that_changes_meanwhile_is_noticed(tmp_path: Path) -> None:
    files = [written(tmp_path / f"{number}.hdf5", rows()) for number in range(2)]

    def change(done: int, total: int) -> None:
        if done == 1:
            written(files[1], rows(rewards=np.ones(6, dtype=np.float32)))

    with pytest.raises(StoreError, match=r"1.hdf5 changed meanwhile"):
        import_dataset("hdf5", files, tmp_path / "data", progress=change)
    with pytest.raises(TcmrlError):
        open_dataset(tmp_path / "data")


def test_foreign_tasks_cannot_be_drawn_again(exported: list[Path], tmp_path: Path) -> None:
    found = imported(exported, tmp_path / "data")
    (found.folder / TASK_TABLE).write_bytes(b"")
    with pytest.raises(BuildError, match="import or record them again"):
        repair_dataset(found.folder)


@pytest.mark.parametrize("text", ["[{}]", "{", f"[{ENTRY}, {ENTRY}]"])
def test_a_bad_list_of_tasks_is_refused(text: str, exported: list[Path], tmp_path: Path) -> None:
    (tmp_path / "tasks.json").write_text(text)
    with pytest.raises(TaskError, match=r"tasks.json"):
        import_dataset("hdf5", exported, tmp_path / "data", tasks=tmp_path / "tasks.json")
    assert not (tmp_path / "data").exists()


def test_the_command(exported: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    command = ["import", "hdf5", *map(str, exported), "--out", str(out)]
    assert run(data, [*command, "--dry-run", "--json"]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert (planned["parts"], planned["root"], out.exists()) == (15, None, False)
    assert run(data, command) == 0
    printed = capsys.readouterr().out
    assert f"foreign, {len(TASKS)} tasks, 15 parts, 90 episodes with 1,800 steps" in printed
    assert run(data, [*command, "--quiet"]) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    other = ["import", "hdf5", str(exported[0]), "--out", str(tmp_path / "other")]
    for more, message in (
        (["--option", "layout=robomimic"], "layout"),
        (["--option", "layout"], "expected NAME=VALUE"),
        (["--environment", "nowhere"], "unknown environment 'nowhere'"),
        (["--task-file", str(tmp_path / "no.json")], "no.json cannot be read"),
        ([str(tmp_path / "no.hdf5")], "no.hdf5 cannot be read"),
        ([str(exported[0])], "is in the files twice"),
    ):
        assert run(data, [*other, *more]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
    assert run(data, ["import", "hdf6", *other[2:]]) == 2
    assert "unknown import format 'hdf6'" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


@pytest.mark.check
def test_a_stopped_import_goes_on(exported: list[Path], tmp_path: Path) -> None:
    class Stop(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 7:
            raise Stop

    whole = import_dataset("hdf5", exported, tmp_path / "whole")
    out = tmp_path / "data"
    with pytest.raises(Stop):
        import_dataset("hdf5", exported, out, progress=stop)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.zip")}
    assert len(before) == 7
    with pytest.raises(StoreError, match="beginning of another dataset"):
        import_dataset("hdf5", exported[:2], out)
    assert import_dataset("hdf5", exported, out).root == whole.root
    assert before.items() <= {path: path.stat().st_mtime_ns for path in out.rglob("*.zip")}.items()
