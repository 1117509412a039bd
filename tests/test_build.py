import json
import os
import subprocess
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
from tcmrl_data.build.driver import Driver
from tcmrl_data.build.events import EventLog
from tcmrl_data.build.plan import plan_build
from tcmrl_data.build.unit import UnitSpec, run_unit
from tcmrl_data.engine.base import BaseEngine, Message, Result, Unit
from tcmrl_data.envs.base import LaneStep
from tcmrl_data.envs.point_robot import PointRobotLanes
from tcmrl_data.envs.trajectory import BoolArray, FloatArray
from tcmrl_data.foundation.disk import LOCK, lock_file
from tcmrl_data.foundation.errors import BuildError, LockedError, ManifestError, StoreError
from tcmrl_data.recipe.tasks import choose_tasks
from tcmrl_data.store.manifest import MANIFEST, read_manifest
from tests.conftest import TASKS, TINY

Copy = Callable[[], Path]


def ids(folder: Path) -> dict[tuple[int, int], str]:
    return {(part.task, part.step): part.id for part in read_manifest(folder).parts}


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
    assert not {part.id for part in other.manifest.parts} & {part.id for part in tiny.manifest.parts}
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
    lost = open_dataset(folder).folder_of(40, 150)
    subprocess.run(["rm", "-r", str(lost)], check=True)
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, workers=1)
    assert (report.built, report.present) == (1, 14)
    assert ids(folder) == ids(tiny_folder)


def test_another_recipe_or_seed_is_refused(tiny_copy: Copy, tiny_recipe: Recipe) -> None:
    folder = tiny_copy()
    other = load_recipe("point-robot", profile="quick", overrides=[*TINY, "behavior.sac.gamma=0.5"])
    with pytest.raises(BuildError, match=r"behavior.settings.gamma is 0.9 there and 0.5 here"):
        tcmrl_data.build_dataset(other, folder, tasks=TASKS)
    with pytest.raises(BuildError, match="seed 0, not 4"):
        tcmrl_data.build_dataset(tiny_recipe, folder, seed=4)


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path, tiny_recipe: Recipe) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(BuildError, match="no dataset"):
        tcmrl_data.build_dataset(tiny_recipe, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_two_builders_at_once_one_is_refused_by_name(tiny_copy: Copy, tiny_recipe: Recipe) -> None:
    folder = tiny_copy()
    with lock_file(folder / LOCK, "the dataset"), pytest.raises(LockedError, match=f"process {os.getpid()}"):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)


@pytest.mark.parametrize("name", ["rewards/c/0", "policy.safetensors", "observations/zarr.json"])
def test_a_flipped_bit_stops_the_build_and_names_the_file(
    tiny_copy: Copy, tiny_recipe: Recipe, name: str
) -> None:
    folder = tiny_copy()
    file = folder / "tasks/00003/snapshots/step_0000100" / name
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises((StoreError, ManifestError), match=str(file)):
        tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)


def test_a_failing_unit_is_reported_and_the_others_are_done(tmp_path: Path, tiny_recipe: Recipe) -> None:
    """A file in the place of one task's part makes that unit fail for good."""
    out = tmp_path / "poisoned"
    blocked = out / "tasks/00003/snapshots"
    blocked.mkdir(parents=True)
    (blocked / "step_0000100").write_text("in the way")
    report = tcmrl_data.build_dataset(tiny_recipe, out, tasks=[0, 3], workers=2)
    assert [failure.split(" failed")[0] for failure in report.failed] == ["task 3"]
    assert not read_manifest(out).complete
    assert set(ids(out)) == {(0, 0), (0, 100), (0, 150), (3, 0)}


def test_the_manifest_is_its_canonical_form(tiny_folder: Path) -> None:
    data = (tiny_folder / MANIFEST).read_bytes()
    values = json.loads(data)
    assert tcmrl_data.canonical_json(values) == data
    assert values["tasks"][1] == {
        "index": 3,
        "split": "test",
        "parameters": {"goal": [0.9954719226, 0.0950560433], "wind": [0.0, 0.0]},
    }
    assert values["references"]["3"]["oracle"] > values["references"]["3"]["uniform"]


def test_a_foreign_file_does_not_stop_a_build_and_is_verifys_to_name(
    tiny_copy: Copy, tiny_recipe: Recipe
) -> None:
    folder = tiny_copy()
    (folder / "README.md").write_text("mine")
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS)
    assert (report.built, report.present) == (0, 15)
    (finding,) = tcmrl_data.verify_dataset(folder).findings
    assert (finding.file, finding.foreign) == ("README.md", True)


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
    driver = Driver(plan_build(tiny_recipe, tasks=[3]), tmp_path)
    with EventLog(tmp_path, lambda event: None) as log:
        (failure,) = driver.run(HastyEngine(), log)
    assert "task 3 failed" in failure
    assert "ended without 3 of its parts, the first is tasks/00003/snapshots/step_0000000" in failure
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
    spec = UnitSpec(tmp_path, tiny_recipe, 0, tuple(choose_tasks(tiny_recipe, [3])))
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
