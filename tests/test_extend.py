"""`extend`: further episodes of stored policies, in place and as a new dataset."""

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import Dataset, extend_dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.errors import BuildError, NondeterminismError, SelectionError
from tcmrl_data.store.part import _machine
from tcmrl_data.store.tables import PartKey
from tests.commands import assert_refused, in_process
from tests.conftest import SIMULATED

pytestmark = pytest.mark.usefixtures("module_in_process")

CopyTiny = Callable[[], Path]


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cheetah") / "data"
    recipe = tcmrl_data.load_recipe("half-cheetah-vel", profile="quick", overrides=SIMULATED)
    assert tcmrl_data.build_dataset(recipe, folder, tasks=[0, 1], workers=2).failed == ()
    return folder


def arrays(dataset: Dataset, key: PartKey, episodes: slice = slice(None)) -> list[bytes]:
    """The bytes of some episodes of a part."""
    return [
        np.concatenate([trajectory.observations.ravel(), trajectory.actions.ravel(), trajectory.rewards])
        .astype(np.float32)
        .tobytes()
        for trajectory in dataset.trajectories(*key)[episodes]
    ]


@pytest.mark.parametrize("environment", ["point-robot", "half-cheetah-vel"])
def test_stored_episodes_come_back_bit_for_bit_and_later_ones_are_new(
    environment: str, tiny_folder: Path, cheetah: Path, tmp_path: Path
) -> None:
    source = tiny_folder if environment == "point-robot" else cheetah
    number = open_dataset(source).manifest.recipe.rollouts.episodes
    again, out = (tmp_path / name for name in ("again", "out"))
    extend_dataset(source, out=out, episodes=2 * number, first_episode=0, tasks=[0], workers=1)
    extend_dataset(source, out=again, episodes=number, tasks=[0], workers=1)
    whole, later = open_dataset(out), open_dataset(again)
    assert whole.manifest.complete
    old = open_dataset(source).select(tasks=[0], snapshots="last").parts[0][0]
    new = old._replace(run="extended")
    assert arrays(whole, new, slice(number)) == arrays(whole, old)
    assert arrays(whole, new, slice(number, None)) == arrays(later, new)
    assert not {*arrays(whole, new, slice(number, None))} & {*arrays(whole, old)}
    assert verify_dataset(out, level="deep", replay=100).findings == ()


def test_extension_in_place_keeps_what_is_there(tiny_copy: CopyTiny) -> None:
    folder = tiny_copy()
    before = open_dataset(folder)
    first = extend_dataset(folder, episodes=3, tasks=[0, 99], snapshots="steps>=100", workers=1)
    assert (first.made, first.present, first.runs) == (4, 0, ("extended",))
    again = extend_dataset(folder, episodes=3, tasks=[0, 3, 99], snapshots="steps>=100", workers=1)
    assert (again.made, again.present) == (2, 4)
    dataset = open_dataset(folder)
    assert dataset.manifest.complete
    assert dataset.manifest.derivation is None
    assert [*before.parts.entries()] == [entry for entry in dataset.parts.entries() if entry.run == "main"]
    assert dataset.entry(PartKey(0, 150, "extended")).episodes == 3
    assert dataset.entry(PartKey(0, 150, "extended")).oracle == dataset.entry(PartKey(0, 150)).oracle
    assert verify_dataset(folder, level="deep", replay=100).findings == ()
    nothing = extend_dataset(folder, episodes=3, tasks=[0], workers=1)
    assert (nothing.made, nothing.root) == (0, dataset.manifest.root)


def test_a_build_keeps_the_runs_that_were_added(tiny_copy: CopyTiny, tiny_recipe: tcmrl_data.Recipe) -> None:
    folder = tiny_copy()
    extend_dataset(folder, episodes=3, tasks=[0], workers=1)
    more = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=[1], workers=1)
    dataset = open_dataset(folder)
    assert (more.built, dataset.manifest.complete) == (3, True)
    assert PartKey(0, 150, "extended") in dataset.parts
    assert verify_dataset(folder).findings == ()


def test_noise_changes_the_actions_and_nothing_else(tiny_copy: CopyTiny) -> None:
    folder = tiny_copy()
    extend_dataset(folder, episodes=6, first_episode=0, noise=0.3, run="noisy", tasks=[0], workers=1)
    dataset = open_dataset(folder)
    plain, noisy = (dataset.trajectories(0, 150, run) for run in ("main", "noisy"))
    starts = [np.array([episode.observations[0] for episode in part]) for part in (plain, noisy)]
    assert np.array_equal(starts[0], starts[1])
    gaps = np.concatenate(
        [left.actions[0] - right.actions[0] for left, right in zip(plain, noisy, strict=True)]
    )
    assert 0.02 < float(np.abs(gaps).mean()) < 1.0
    assert verify_dataset(folder, replay=100).findings == ()


def test_policies_visit_their_nearest_tasks_of_the_same_split(tiny_copy: CopyTiny) -> None:
    folder = tiny_copy()
    tasks = open_dataset(folder).train_tasks
    report = extend_dataset(
        folder, episodes=3, cross=2, run="visitors", tasks=[task.index for task in tasks], workers=2
    )
    dataset = open_dataset(folder)
    assert report.made == 2 * len(tasks)
    spread = np.std([task.parameters["goal"] for task in dataset.tasks], axis=0)
    goals = {task.index: np.array(task.parameters["goal"]) / spread for task in tasks}
    visits = [
        (run.source_of(key.task), key.task)
        for run in dataset.manifest.runs[1:]
        for key in dataset.parts
        if key.run == run.name
    ]
    assert len({*visits}) == len(visits)
    for task, goal in goals.items():
        near = sorted(goals, key=lambda other: float(np.linalg.norm(goals[other] - goal)))[1:3]
        assert {host for source, host in visits if source == task} == {*near}
    for key in dataset.parts:
        if key.run != "main":
            record = dataset.part(*key)
            assert record.identity.derived is not None
            source = PartKey(record.identity.derived["settings"]["task"], key.step)
            assert record.identity.policy == dataset.part(*source).identity.policy
            assert record.identity.derived["from"] == [dataset.entry(source).id]
    assert verify_dataset(folder, replay=100).findings == ()


def test_nothing_is_written_where_the_extension_cannot_be_made(
    tiny_copy: CopyTiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    extend_dataset(folder, episodes=3, tasks=[0], workers=1)
    files = sorted(folder.rglob("*"))
    out = tmp_path / "out"
    for wrong, error, text in (
        ({"of": "other"}, SelectionError, "it has extended, main"),
        ({"episodes": 4}, BuildError, "no multiple of the 3 lanes"),
        ({"first_episode": 1}, BuildError, "--first-episode 1"),
        ({"noise": 11.0}, BuildError, "--noise 11.0"),
        ({"cross": 9}, SelectionError, "choose fewer neighbours"),
        ({"noise": 0.1}, BuildError, "made with other settings"),
        ({"run": "main"}, BuildError, "made with other settings"),
        ({"tasks": [7]}, tcmrl_data.TcmrlError, "no task 7"),
    ):
        with pytest.raises(error, match=text):
            extend_dataset(folder, **({"episodes": 3, "out": out} | wrong))  # type: ignore[arg-type]
    elsewhere = {**_machine(), "cpu": "another one"}
    monkeypatch.setattr("tcmrl_data.store.part._machine", lambda: elsewhere)
    with pytest.raises(NondeterminismError, match="another one here"):
        extend_dataset(folder, episodes=3, run="elsewhere")
    assert extend_dataset(folder, episodes=3, run="elsewhere", allow_drift=True, dry_run=True).made == 5
    assert sorted(folder.rglob("*")) == files
    assert not out.exists()


def test_a_part_in_the_way_is_named_and_a_damaged_one_made_again(tiny_copy: CopyTiny) -> None:
    folder = tiny_copy()
    other = tiny_copy()
    extend_dataset(other, episodes=3, tasks=[0], workers=1)
    expected = open_dataset(other).manifest.root
    place = folder / "parts/extended/00000/0000150.zip"
    place.parent.mkdir(parents=True)
    shutil.copy(folder / "parts/main/00000/0000150.zip", place)
    with pytest.raises(BuildError, match="holds another part; delete it or choose another --as"):
        extend_dataset(folder, episodes=3, tasks=[0], workers=1)
    place.write_bytes(place.read_bytes()[:3000])
    assert extend_dataset(folder, episodes=3, tasks=[0], workers=1).root == expected


@pytest.mark.check
def test_a_killed_extension_goes_on(tiny_copy: CopyTiny) -> None:
    folder, whole = tiny_copy(), tiny_copy()
    arguments = ["--episodes", "3", "--snapshots", "all", "--workers", "1"]
    start = "from tcmrl_cli.data import main; main()"
    command = [sys.executable, "-c", start, "extend", str(folder), *arguments]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not any(folder.glob("parts/extended/*/*.zip")):
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    kept = {file: file.stat().st_mtime_ns for file in folder.glob("parts/extended/*/*.zip")}
    assert "extended" not in open_dataset(folder).parts.runs
    report = extend_dataset(folder, episodes=3, snapshots="all", workers=1)
    assert report.root == extend_dataset(whole, episodes=3, snapshots="all", workers=2).root
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    assert verify_dataset(folder).findings == ()


@pytest.mark.check
def test_repair_makes_extended_parts_and_their_sources_again(tiny_copy: CopyTiny) -> None:
    folder = tiny_copy()
    extend_dataset(folder, episodes=3, tasks=[0], noise=0.1, workers=1)
    dataset = open_dataset(folder)
    damaged = [PartKey(0, 150, "extended"), PartKey(0, 150)]
    for key in damaged:
        dataset.file_of(key).write_bytes(dataset.file_of(key).read_bytes()[:-1])
    report = tcmrl_data.repair_dataset(folder, workers=1)
    assert (report.failed, report.left) == ((), ())
    assert report.repaired == tuple(sorted(damaged))
    assert open_dataset(folder).manifest.root == dataset.manifest.root


def test_command_line(tiny_copy: CopyTiny, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call = in_process(data, capsys)
    folder = tiny_copy()
    code, output, _ = call("extend", folder, "--episodes", 3, "--tasks", "0,3", "--dry-run", "--quiet")
    assert (code, "2 parts" in output) == (0, True)
    code, output, _ = call("extend", folder, "--episodes", 3, "--tasks", "0", "--workers", 1, "--quiet")
    assert (code, "1 part of 3 episodes made" in output) == (0, True)
    assert_refused(call("extend", folder, "--episodes", 4, "--out", tmp_path / "x"), "--episodes 4")
