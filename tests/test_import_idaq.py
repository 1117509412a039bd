"""The `.npy` files of the published code, which are pickles and are read without running them."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tcmrl_data import Trajectory, import_dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.idaq_npy import PickleRefusedError, unpickle_array
from tests.made_up import trajectory

STEPS = 5


def saved(path: Path, episode: Trajectory, *, dtype: Any = np.float64) -> Path:
    """Writes an episode as the published code does."""
    rows = np.empty((len(episode), 4), dtype=object)
    for step in range(len(episode)):
        rows[step] = [
            episode.observations[step].astype(dtype),
            episode.actions[step].astype(dtype),
            dtype(episode.rewards[step]) if step % 2 else float(episode.rewards[step]),
            episode.observations[step + 1].astype(dtype),
        ]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, rows, allow_pickle=True)
    return path


def tasks(folder: Path) -> dict[tuple[int, int], list[Trajectory]]:
    made = {}
    for task in (0, 11):
        for step in (0, 500):
            made[task, step] = [trajectory(STEPS, seed=100 * task + step + number) for number in range(11)]
            for number, episode in enumerate(made[task, step]):
                saved(folder / f"goal_idx{task}" / f"trj_evalsample{number}_step{step}.npy", episode)
    return made


def test_published_files_become_a_dataset(tmp_path: Path) -> None:
    made = tasks(tmp_path / "cheetah")
    saved(tmp_path / "cheetah/goal_idx0/trj_eval0_step0.npy", trajectory(STEPS, seed=0))
    (tmp_path / "cheetah/goal_idx0/log.txt").write_text("nothing")
    report = import_dataset("idaq-npy", [tmp_path / "cheetah"], tmp_path / "data")
    found = open_dataset(tmp_path / "data")
    assert [(key.task, key.step) for key in found.parts] == list(made)
    for (task, step), episodes in made.items():
        for left, right in zip(found.trajectories(task, step), episodes, strict=True):
            np.testing.assert_array_equal(left.observations, right.observations)
            np.testing.assert_array_equal(left.actions, right.actions)
            np.testing.assert_array_equal(left.rewards, right.rewards)
            assert (left.terminated.any(), list(left.truncated)) == (False, [False] * (STEPS - 1) + [True])
    assert report.notes == (
        "cheetah: 1 episodes of the other policy are left out",
        "cheetah: 44 episodes end without a flag and are marked as truncated, not terminated",
    )
    assert verify_dataset(found.folder, level="deep").findings == ()


def test_links_are_followed(tmp_path: Path) -> None:
    """As the cache of a hub keeps files: a linked folder, linked and hard-linked files."""
    made = [saved(tmp_path / f"blobs/{number}.npy", trajectory(STEPS, seed=number)) for number in range(3)]
    (tmp_path / "d/goal_idx0").mkdir(parents=True)
    (tmp_path / "d/goal_idx0/trj_evalsample0_step0.npy").symlink_to(made[0])
    (tmp_path / "d/goal_idx0/trj_evalsample1_step0.npy").hardlink_to(made[1])
    (tmp_path / "other").mkdir()
    made[2].rename(tmp_path / "other/trj_evalsample0_step0.npy")
    (tmp_path / "d/goal_idx1").symlink_to(tmp_path / "other")
    report = import_dataset("idaq-npy", [tmp_path / "d"], tmp_path / "data")
    assert (report.tasks, report.episodes) == (2, 3)


def test_the_deterministic_policy_can_be_chosen(tmp_path: Path) -> None:
    tasks(tmp_path / "cheetah")
    saved(tmp_path / "cheetah/goal_idx0/trj_eval0_step0.npy", trajectory(STEPS, seed=7), dtype=np.float32)
    options = {"episodes": "deterministic"}
    report = import_dataset("idaq-npy", [tmp_path / "cheetah"], tmp_path / "data", options=options)
    assert (report.tasks, report.episodes) == (1, 1)


class RunsCode:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (f"touch {self.marker}",)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_no_protocol_runs_code(protocol: int, tmp_path: Path) -> None:
    data = pickle.dumps(RunsCode(tmp_path / "ran"), protocol=protocol)
    with pytest.raises(PickleRefusedError):
        unpickle_array(data)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("protocol", [2, 3, 4])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<i8", "|b1"])
def test_arrays_are_read_from_all_protocols(protocol: int, dtype: str) -> None:
    array = np.arange(6).reshape(2, 3).astype(dtype)
    np.testing.assert_array_equal(unpickle_array(pickle.dumps(array, protocol=protocol)).numbers(), array)


@pytest.mark.parametrize(
    "value", [[1, 2], {"a": 1}, np.float64(1), np.zeros(2, "U8"), np.zeros(2, [("a", "f8")]), None, Path(".")]
)
def test_anything_but_an_array_of_numbers_is_refused(value: Any) -> None:
    with pytest.raises(PickleRefusedError):
        unpickle_array(pickle.dumps(value)).numbers()


def test_a_plain_array_has_no_rows(tmp_path: Path) -> None:
    (tmp_path / "d/goal_idx0").mkdir(parents=True)
    np.save(tmp_path / "d/goal_idx0/trj_evalsample0_step0.npy", np.zeros((5, 4)))
    with pytest.raises(StoreError, match=r"trj_evalsample0_step0.npy is no object array of rows of 4"):
        import_dataset("idaq-npy", [tmp_path / "d"], tmp_path / "data")
    with pytest.raises(StoreError, match="name the folder of the tasks"):
        import_dataset("idaq-npy", [tmp_path / "d/goal_idx0"], tmp_path / "data")
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("numbers", "problem"),
    [("[7]", "has no task 1; it lists 1"), ("[7, 7]", "names a task twice"), ('{"0": 7}', "is no list of")],
)
def test_numbers_of_tasks_that_do_not_fit_the_folders_are_refused(
    numbers: str, problem: str, tmp_path: Path
) -> None:
    for task in (0, 1):
        saved(tmp_path / f"d/goal_idx{task}/trj_evalsample0_step0.npy", trajectory(STEPS, seed=task))
    (tmp_path / "d/task_numbers.json").write_text(numbers)
    with pytest.raises(StoreError, match=problem):
        import_dataset("idaq-npy", [tmp_path / "d"], tmp_path / "data")
    assert not (tmp_path / "data").exists()
