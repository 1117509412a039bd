import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Dataset, list_datasets, open_dataset
from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.errors import ManifestError, SelectionError, StoreError, TaskError
from tcmrl_data.store.manifest import MANIFEST, seal
from tests.conftest import TASKS

Copy = Callable[[], Path]


def test_a_dataset_opens_by_folder_or_manifest(tiny: Dataset, tiny_folder: Path) -> None:
    by_manifest = open_dataset(tiny_folder / MANIFEST)
    assert by_manifest.manifest == tiny.manifest
    assert [task.index for task in tiny.tasks] == TASKS
    assert [task.index for task in tiny.test_tasks] == [3]


def test_episodes_are_complete_and_time_limits_are_no_terminals(tiny: Dataset) -> None:
    episodes = tiny.trajectories(0, 150)
    assert len(episodes) == 6
    for episode in episodes:
        assert (episode.observations.shape, episode.observations.dtype) == ((21, 2), np.float32)
        assert np.abs(episode.actions).max() <= 1
        assert not episode.terminated.any()
        assert episode.truncated.tolist() == [False] * 19 + [True]


def test_rewards_are_of_the_state_after_the_move(tiny: Dataset) -> None:
    goal = np.array(tiny.task(3).parameters["goal"])
    episode = tiny.trajectories(3, 0)[0]
    expected = -np.linalg.norm(episode.observations[1:] - goal, axis=-1)
    np.testing.assert_allclose(episode.rewards, expected, atol=1e-6)


def test_recorded_statistics_are_those_of_the_arrays(tiny: Dataset) -> None:
    statistics = tiny.part(40, 100).statistics
    returns = [trajectory.undiscounted_return for trajectory in tiny.trajectories(40, 100)]
    assert (statistics.mean, statistics.min) == pytest.approx((np.mean(returns), np.min(returns)))
    rows = tiny.arrays(40, 100)["observations"].astype(np.float64)
    np.testing.assert_allclose(statistics.moments["observations"]["sum"], rows.sum(0))
    assert statistics.moments["observations"]["count"] == 6 * 21


def test_selections(tiny: Dataset) -> None:
    assert tiny.select(split="train").steps == dict.fromkeys((0, 40, 60, 99), (0, 100, 150))
    assert tiny.select(tasks=[3], snapshots="last").steps == {3: (150,)}
    assert tiny.select(tasks=[3], snapshots="steps >= 100").steps == {3: (100, 150)}
    best = tiny.select(tasks=[60], snapshots="return>=1.0").steps[60]
    assert best == (max((0, 100, 150), key=lambda step: tiny.part(60, step).statistics.mean),)
    assert len(tiny.select(tasks=[3], snapshots="last").trajectories(3)) == 6


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        ({"snapshots": "best"}, "expected all, last"),
        ({"snapshots": "return>=2"}, "expected all, last"),
        ({"snapshots": "steps>=999"}, r"leaves nothing of task 0, which has \[0, 100, 150\]"),
        ({"tasks": [3], "split": "train"}, "no train tasks"),
    ],
)
def test_bad_selections_say_why(tiny: Dataset, arguments: dict[str, object], pattern: str) -> None:
    with pytest.raises(SelectionError, match=pattern):
        tiny.select(**arguments)  # type: ignore[arg-type]


def test_an_unknown_task_is_named(tiny: Dataset) -> None:
    with pytest.raises(TaskError, match="no task 5"):
        tiny.select(tasks=[5])


def rewritten(folder: Path, **changes: object) -> None:
    """Changes manifest fields and updates the root to match."""
    values = json.loads((folder / MANIFEST).read_bytes()) | changes
    values.pop("digest")
    (folder / MANIFEST).write_bytes(seal(values))


def test_manifests_that_must_not_open(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    file = folder / MANIFEST
    good = file.read_bytes()
    values = json.loads(good)

    def refuse(pattern: str) -> None:
        with pytest.raises(ManifestError, match=pattern):
            open_dataset(folder)
        file.write_bytes(good)

    file.write_bytes(good[: len(good) // 2])
    refuse("not a manifest")
    file.write_bytes(good.replace(b'"seed":0', b'"seed":1', 1))
    refuse("digest does not match")
    rewritten(folder, schema_version=2)
    refuse("schema_version 2 is not 1")
    rewritten(folder, surprise=1)
    refuse("surprise: Extra inputs")
    rewritten(folder, seed="0")
    refuse("seed: Input should be a valid integer")
    rewritten(folder, root="0" * 64)
    refuse("root does not match")
    rewritten(folder, name="../etc")
    refuse("name: ")
    rewritten(folder, parts=[*values["parts"], values["parts"][0]])
    refuse("sorted by task and step, each once")
    file.write_bytes(good.replace(b'{"complete"', b'{"complete":true,"complete"', 1))
    refuse("duplicate key 'complete'")
    file.write_bytes(good.replace(b'"seed":0', b'"seed":NaN', 1))
    refuse("NaN is not allowed")
    file.write_bytes(b"[" * 10**5)
    refuse("nested deeper")
    file.unlink()
    refuse("does not exist; build a dataset")
    open_dataset(folder)


@pytest.mark.parametrize("name", ["rewards/c/0", "episode_offsets/zarr.json", "part.json", "policy.json"])
def test_a_missing_or_linked_file_is_named(tiny_copy: Copy, tmp_path: Path, name: str) -> None:
    folder = tiny_copy()
    file = folder / "tasks/00060/snapshots/step_0000150" / name
    moved = tmp_path / "elsewhere"
    file.rename(moved)
    with pytest.raises((StoreError, ManifestError), match=str(file)):
        open_dataset(folder)
    file.symlink_to(moved)
    with pytest.raises((StoreError, ManifestError), match=str(file)):
        open_dataset(folder)


def test_a_swapped_part_is_found(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    left, right = (folder / "tasks/00060/snapshots" / f"step_0000{step}" / "part.json" for step in (100, 150))
    left.write_bytes(right.read_bytes())
    with pytest.raises(ManifestError, match="not the record that the manifest names"):
        open_dataset(folder)


def test_a_part_with_an_edited_identity_is_found(tiny_copy: Copy) -> None:
    file = tiny_copy() / "tasks/00060/snapshots/step_0000150/part.json"
    values = json.loads(file.read_bytes())
    values["identity"]["seed"] = 9
    assert values["id"] != digest(values["identity"])
    file.write_text(json.dumps(values))
    with pytest.raises(ManifestError, match="id is not the digest"):
        open_dataset(file.parents[4])


def test_datasets_are_listed(tiny_folder: Path, tiny_copy: Copy) -> None:
    broken = tiny_copy()
    (broken / MANIFEST).write_text("{}")
    row = next(row for row in list_datasets(tiny_folder.parent) if row["path"] == str(tiny_folder))
    assert (row["name"], row["tasks"], row["parts"], row["complete"]) == ("point-robot", 5, 15, True)
    assert "schema_version" in list_datasets(broken.parent)[0]["error"]


def test_a_task_that_is_named_twice_counts_once(tiny: Dataset) -> None:
    assert [task.index for task in tiny.select(tasks=[40, 0, 40]).tasks] == [40, 0]


def test_parts_that_a_repair_makes_again_are_not_listed(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    shutil.copytree(folder, folder.parent / "staged")
    (folder / ".staging").mkdir(exist_ok=True)
    (folder.parent / "staged").rename(folder / ".staging" / "repair")
    assert [row["path"] for row in list_datasets(folder.parent)] == [str(folder)]
