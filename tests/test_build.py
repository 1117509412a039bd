import errno
import json
import shutil
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import final

import numpy as np
import pytest

import tcmrl_data
from tcmrl_data import (
    Dataset,
    Purpose,
    Recipe,
    UniformController,
    keyed_generator,
    keyed_seed,
    load_recipe,
    open_dataset,
    roll_out,
)
from tcmrl_data.building.build import Driver
from tcmrl_data.building.ledger import Ledger
from tcmrl_data.building.plan import UnitSpec, plan_build, run_unit
from tcmrl_data.building.work_files import BuildEvent, StatusFile
from tcmrl_data.engine.base import BaseEngine, Message, Result, Unit
from tcmrl_data.envs.base import LaneStep
from tcmrl_data.envs.point_robot import PointRobotLanes
from tcmrl_data.envs.rollout import BoolArray, FloatArray
from tcmrl_data.foundation.disk import LOCK
from tcmrl_data.foundation.errors import BuildError, ManifestError, StoreError
from tcmrl_data.store import archive as archive_module
from tcmrl_data.store.archive import Archive, pack_archive
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, read_manifest
from tcmrl_data.store.part import PART_SCHEMA, RECORD
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import TASKS as TASKS_TABLE
from tcmrl_data.store.tables import PartKey, part_file
from tests.conftest import TASKS, TINY

pytestmark = pytest.mark.usefixtures("module_in_process")

Copy = Callable[[], Path]


def forget(folder: Path) -> None:
    """Leaves the parts of a dataset and nothing that names them."""
    for name in (MANIFEST, MANIFEST_COPY, TASKS_TABLE, PARTS_TABLE):
        (folder / name).unlink()


def ids(folder: Path) -> dict[PartKey, str]:
    return {entry.key: entry.id for entry in open_dataset(folder).recorded_parts.entries()}


def test_ids_do_not_depend_on_workers_halves_or_training_defaults(tiny_folder: Path, tmp_path: Path) -> None:
    edited = load_recipe("point-robot", profile="quick", overrides=[*TINY, "training.steps=17"])
    for half in ([0, 40], [99, 3, 60]):
        tcmrl_data.build_dataset(edited, tmp_path / "halves", tasks=half, workers=1)
    assert ids(tmp_path / "halves") == ids(tiny_folder)
    assert read_manifest(tmp_path / "halves").root == read_manifest(tiny_folder).root
    assert read_manifest(tmp_path / "halves").training["quick"]["steps"] == 17


def test_another_seed_has_other_data_for_the_same_tasks(
    tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    tcmrl_data.build_dataset(tiny_recipe, tmp_path / "other", seed=1, tasks=[0, 3], workers=2)
    other = open_dataset(tmp_path / "other")
    assert not {*ids(other.folder).values()} & {*ids(tiny.folder).values()}
    assert [other.task(index) for index in (0, 3)] == [tiny.task(index) for index in (0, 3)]


def test_a_finished_dataset_is_verified_and_left_alone(tiny_copy: Copy, tiny_recipe: Recipe) -> None:
    folder = tiny_copy()
    before = {
        path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file() and path.name != LOCK
    }
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)
    after = {
        path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file() and path.name != LOCK
    }
    assert (report.built, report.present) == (0, 15)
    assert before == after


def test_a_second_build_does_only_what_is_missing(
    tiny_copy: Copy, tiny_recipe: Recipe, tiny_folder: Path
) -> None:
    folder = tiny_copy()
    forget(folder)
    (folder / part_file(PartKey(40, 150))).unlink()
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, workers=1)
    assert (report.built, report.present) == (1, 14)
    assert ids(folder) == ids(tiny_folder)
    assert read_manifest(folder).root == read_manifest(tiny_folder).root


@pytest.mark.parametrize("problem", ["is missing", "has 7 bytes instead of"])
def test_a_recorded_part_that_is_gone_or_cut_is_left_to_repair(
    tiny_copy: Copy, tiny_recipe: Recipe, tiny_folder: Path, problem: str
) -> None:
    folder = tiny_copy()
    file = folder / part_file(PartKey(40, 150))
    file.unlink()
    if problem != "is missing":
        file.write_bytes(b"PK\x03\x04...")
    with pytest.raises(StoreError, match=f"{file} {problem}.*; run `tcmrl-data verify {folder} --repair`"):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)
    assert tcmrl_data.repair_dataset(folder, workers=1).repaired == (PartKey(40, 150),)
    assert tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS).present == 15
    assert file.read_bytes() == (tiny_folder / part_file(PartKey(40, 150))).read_bytes()


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "a byte of an array": lambda data: data[:2_000] + bytes([data[2_000] ^ 1]) + data[2_001:],
    "the last byte": lambda data: data[:-1] + bytes([data[-1] ^ 1]),
    "the second half": lambda data: data[: len(data) // 2],
    "everything": lambda data: b"",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_part_damaged_before_it_was_recorded_is_made_again_and_named(
    tiny_copy: Copy, tiny_recipe: Recipe, tiny_folder: Path, damage: str
) -> None:
    folder = tiny_copy()
    forget(folder)
    file = folder / part_file(PartKey(3, 100))
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    events: list[BuildEvent] = []
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, workers=1, progress=events.append)
    assert (report.built, report.present, report.failed) == (1, 14, ())
    (warning,) = [event.message for event in events if event.kind == "warning"]
    assert warning == f"{file} was damaged before it was recorded; it is made again"
    assert file.read_bytes() == (tiny_folder / part_file(PartKey(3, 100))).read_bytes()
    assert tcmrl_data.verify_dataset(folder).findings == ()


def test_a_sound_part_of_another_seed_or_recipe_or_task_is_refused_by_name(
    tiny_copy: Copy, tiny_recipe: Recipe, tiny_folder: Path, tmp_path: Path
) -> None:
    """Such a part was put there by hand: deleting it is left to the user."""
    folder = tiny_copy()
    forget(folder)
    other = load_recipe("point-robot", profile="quick", overrides=[*TINY, "rollouts.episodes=3"])
    with pytest.raises(StoreError, match=r"0000000.zip: was built with other settings; delete it"):
        tcmrl_data.build_dataset(other, folder, tasks=TASKS)
    with pytest.raises(StoreError, match=r"0000000.zip: holds another part; delete it"):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, seed=1)
    file = folder / part_file(PartKey(3, 100))
    shutil.copyfile(tiny_folder / part_file(PartKey(0, 100)), file)
    with pytest.raises(StoreError, match=f"{file}: holds another part; delete it"):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)
    assert not (folder / MANIFEST).exists()
    file.unlink()
    assert tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, workers=1).built == 1


def test_another_recipe_or_seed_is_refused(tiny_copy: Copy, tiny_recipe: Recipe) -> None:
    folder = tiny_copy()
    other = load_recipe("point-robot", profile="quick", overrides=[*TINY, "behavior.sac.gamma=0.5"])
    with pytest.raises(BuildError, match=r"behavior.settings.gamma is 0.9 there and 0.5 here"):
        tcmrl_data.build_dataset(other, folder, tasks=TASKS)
    with pytest.raises(BuildError, match="seed 0, not 4"):
        tcmrl_data.build_dataset(tiny_recipe, folder, seed=4)


def test_a_part_that_a_later_version_made_or_that_cannot_be_read_is_not_deleted(
    tiny_copy: Copy, tiny_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    forget(folder)
    file = folder / part_file(PartKey(3, 100))
    with Archive(file) as archive:
        members = {name: archive.read(name) for name in archive.names}
    later = json.loads(members[RECORD]) | {"schema_version": PART_SCHEMA + 1}
    data = pack_archive(members | {RECORD: tcmrl_data.canonical_json(later)})
    file.write_bytes(data)
    with pytest.raises(StoreError, match=f"{file}: its record is not of this version; delete it"):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)

    def refuse(descriptor: int, size: int, offset: int) -> bytes:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(archive_module, "pread", refuse)
    with pytest.raises(StoreError, match=r"cannot be read \(Input/output error\); try again, or delete it"):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)
    assert file.read_bytes() == data


@pytest.mark.parametrize("name", [TASKS_TABLE, PARTS_TABLE])
def test_a_flipped_bit_of_a_table_stops_the_build_and_names_the_file(
    tiny_copy: Copy, tiny_recipe: Recipe, name: str
) -> None:
    file = tiny_copy() / name
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(ManifestError, match=f"{file}: its first .*; run `tcmrl-data verify --repair`"):
        tcmrl_data.build_dataset(tiny_recipe, file.parent, tasks=TASKS)


def test_a_failing_unit_is_reported_and_the_others_are_done(tmp_path: Path, tiny_recipe: Recipe) -> None:
    """A folder that comes into the place of one task's part makes that unit fail for good."""
    out = tmp_path / "poisoned"
    blocked = out / part_file(PartKey(3, 100))

    def block(event: BuildEvent) -> None:
        (blocked / "in the way").mkdir(parents=True, exist_ok=True)

    report = tcmrl_data.build_dataset(tiny_recipe, out, tasks=[0, 3], workers=2, progress=block)
    assert [failure.split(" failed")[0] for failure in report.failed] == ["task 3"]
    assert not read_manifest(out).complete
    assert set(ids(out)) == {PartKey(0, 0), PartKey(0, 100), PartKey(0, 150), PartKey(3, 0)}
    with pytest.raises(StoreError, match=f"{blocked} is a folder, not a plain file; delete it"):
        tcmrl_data.build_dataset(tiny_recipe, out, tasks=[0, 3])


def test_the_manifest_and_the_tables_are_canonical(tiny_folder: Path) -> None:
    for name in (MANIFEST, TASKS_TABLE, PARTS_TABLE):
        lines = (tiny_folder / name).read_bytes().splitlines(keepends=True)
        assert [tcmrl_data.canonical_json(json.loads(line)) for line in lines] == lines
    assert json.loads((tiny_folder / TASKS_TABLE).read_bytes().splitlines()[1]) == {
        "index": 3,
        "split": "test",
        "parameters": {"goal": [0.9954719226, 0.0950560433], "wind": [0.0, 0.0]},
    }
    manifest = read_manifest(tiny_folder)
    assert (manifest.tasks.lines, manifest.parts.lines, manifest.totals.parts) == (5, 16, 15)
    assert manifest.totals.bytes == sum(file.stat().st_size for file in tiny_folder.rglob("*.zip"))


def test_a_foreign_file_does_not_stop_a_build_and_is_verifys_to_name(
    tiny_copy: Copy, tiny_recipe: Recipe
) -> None:
    folder = tiny_copy()
    (folder / "notes.md").write_text("mine")
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)
    assert (report.built, report.present) == (0, 15)
    verified = tcmrl_data.verify_dataset(folder)
    assert (verified.findings, [note.file for note in verified.notes]) == ((), ["notes.md"])


def test_a_seed_beyond_int64_is_refused(tiny_recipe: Recipe, tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=r"seed 18446744073709551616 is not in \[0, 2\*\*63\)"):
        tcmrl_data.build_dataset(tiny_recipe, tmp_path / "out", seed=2**64, tasks=[0])
    assert not (tmp_path / "out").exists()


@final
class HastyEngine(BaseEngine):
    """Reports every unit as done and does nothing."""

    name = "hasty"

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        yield from (Result(unit.id, True, "0" * 64, None, 1, "here") for unit in units)


def test_a_unit_that_is_done_without_its_parts_failed(tiny_recipe: Recipe, tmp_path: Path) -> None:
    driver = Driver(Ledger(plan_build(tiny_recipe, tasks=[3]), tmp_path), tmp_path)
    (failure,) = driver.run(HastyEngine(), StatusFile(tmp_path))
    assert "task 3 failed" in failure
    assert "ended without 3 of its parts, the first is parts/main/00003/0000000.zip" in failure
    assert not read_manifest(tmp_path).complete


def test_a_reward_that_is_not_finite_is_named(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = PointRobotLanes.step

    def step_with_nan(self: PointRobotLanes, actions: FloatArray, active: BoolArray) -> LaneStep:
        done = step(self, actions, active)
        done.rewards[1] = np.nan
        return done

    monkeypatch.setattr(PointRobotLanes, "step", step_with_nan)
    spec = UnitSpec(tmp_path, plan_build(tiny_recipe, tasks=[3]))
    with pytest.raises(BuildError, match="task 3, snapshot step 0, episode 1: rewards are not finite"):
        run_unit(spec, lambda message: None)


def test_references_are_means_of_the_recipes_number_of_episodes(tiny: Dataset, tiny_recipe: Recipe) -> None:
    environment, key = tiny.environment, (0, "point-robot", 40)
    returns = []
    for first in (0, 3):
        episodes = range(first, first + 3)
        lanes = environment.lanes([tiny.task(40).parameters] * 3)
        returns += roll_out(
            environment,
            lanes,
            UniformController(),
            reset_seeds=[keyed_seed(*key, Purpose.REFERENCE_RESET, episode) for episode in episodes],
            noise=[keyed_generator(*key, Purpose.REFERENCE_NOISE, episode) for episode in episodes],
        )
    assert len(returns) == tiny_recipe.rollouts.episodes
    mean = np.mean([trajectory.undiscounted_return for trajectory in returns])
    assert tiny.references(40).uniform == pytest.approx(mean)
