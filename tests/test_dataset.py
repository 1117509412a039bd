import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Dataset, list_datasets, open_dataset
from tcmrl_data.foundation.errors import ManifestError, SelectionError, StoreError, TaskError
from tcmrl_data.foundation.records import canonical_json, digest, sealed
from tcmrl_data.store.archive import Archive, pack_archive
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part import RECORD
from tcmrl_data.store.part_table import PARTS_TABLE, PartTable
from tcmrl_data.store.tables import TASKS as TASKS_TABLE
from tcmrl_data.store.tables import PartKey, part_file, seal_of
from tcmrl_data.verification.repair import write_tables
from tests.conftest import TASKS

Copy = Callable[[], Path]


def test_a_dataset_opens_by_folder_or_manifest(tiny: Dataset, tiny_folder: Path) -> None:
    by_manifest = open_dataset(tiny_folder / MANIFEST)
    assert by_manifest.manifest == tiny.manifest
    assert [task.index for task in tiny.tasks] == TASKS
    assert [task.index for task in tiny.test_tasks] == [3]


def test_a_dataset_can_be_sent_to_another_process(tiny: Dataset) -> None:
    tiny.part(0, 150)  # what is kept in memory does not travel
    sent = pickle.loads(pickle.dumps(tiny))
    assert sent.manifest == tiny.manifest
    assert sent.part(0, 150) == tiny.part(0, 150)


def test_episodes_are_complete_and_time_limits_are_no_terminals(tiny: Dataset) -> None:
    episodes = tiny.trajectories(0, 150)
    assert len(episodes) == 6
    for episode in episodes:
        assert (episode.observations.shape, episode.observations.dtype.name) == ((21, 2), "float32")
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


def keys(task: int, *steps: int) -> tuple[PartKey, ...]:
    return tuple(PartKey(task, step) for step in steps)


def test_selections(tiny: Dataset) -> None:
    assert tiny.select(split="train").parts == {task: keys(task, 0, 100, 150) for task in (0, 40, 60, 99)}
    assert tiny.select(tasks=[3], snapshots="last").parts == {3: keys(3, 150)}
    assert tiny.select(tasks=[3], snapshots="steps >= 100").parts == {3: keys(3, 100, 150)}
    best = tiny.select(tasks=[60], snapshots="return>=1.0").parts[60]
    assert best == keys(60, max((0, 100, 150), key=lambda step: tiny.part(60, step).statistics.mean))
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
    """Changes manifest fields and seals the manifest again."""
    values = json.loads((folder / MANIFEST).read_bytes()) | changes
    values.pop("digest")
    (folder / MANIFEST).write_bytes(sealed(values))


def test_lines_behind_the_sealed_ones_do_not_count(tiny: Dataset, tiny_copy: Copy) -> None:
    folder = tiny_copy()
    for name in (TASKS_TABLE, PARTS_TABLE):
        with (folder / name).open("ab") as file:
            file.write(b"the log of a build\n")
    opened = open_dataset(folder)
    assert (opened.tasks, list(opened.parts)) == (tiny.tasks, list(tiny.parts))


def test_a_missing_part_is_named(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    file = folder / part_file(PartKey(60, 150))
    file.unlink()
    for read in (Dataset.part, Dataset.trajectories, Dataset.snapshot):
        with pytest.raises(StoreError, match=str(file)):
            read(open_dataset(folder), 60, 150)


def test_a_part_of_a_task_that_the_dataset_does_not_have_is_refused(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    lines = (folder / TASKS_TABLE).read_bytes().splitlines(keepends=True)
    (folder / TASKS_TABLE).write_bytes(b"".join(lines[1:]))
    rewritten(folder, tasks=seal_of(b"".join(lines[1:])).model_dump())
    with pytest.raises(ManifestError, match=r"names a task that tasks.jsonl does not have"):
        open_dataset(folder).select()


def test_a_part_of_another_size_is_found(tiny_copy: Copy) -> None:
    file = tiny_copy() / part_file(PartKey(60, 150))
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(StoreError, match=r"has \d+ bytes instead of \d+|is no archive"):
        open_dataset(file.parents[3]).part(60, 150)


def test_a_swapped_part_is_found(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    dataset = open_dataset(folder)
    left, right = keys(60, 100, 150)
    (folder / part_file(left)).write_bytes((folder / part_file(right)).read_bytes())
    with pytest.raises(StoreError, match=r"has \d+ bytes instead of"):
        open_dataset(folder).part(*left)
    same_size = dataset.entry(left)._replace(size=dataset.entry(right).size)
    table = [same_size if entry.key == left else entry for entry in dataset.parts.entries()]
    write_tables(
        folder,
        dataset.manifest,
        tasks=dataset.tasks,
        table=PartTable.empty().with_entries(table),
        platforms=dataset.manifest.platforms,
    )
    with pytest.raises(ManifestError, match="not the part that the manifest names"):
        open_dataset(folder).part(*left)


def test_a_part_with_an_edited_identity_is_found(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    file = folder / part_file(PartKey(60, 150))
    with Archive(file) as archive:
        files = {name: archive.read(name) for name in archive.names}
    values = json.loads(files[RECORD])
    values["identity"]["seed"] = 9
    assert values["id"] != digest(values["identity"])
    file.write_bytes(pack_archive(files | {RECORD: canonical_json(values)}))
    with pytest.raises(ManifestError, match="id is not the digest"):
        open_dataset(folder).part(60, 150)


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
