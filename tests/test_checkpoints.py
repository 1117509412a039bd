import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any

import numpy as np
import pytest

import tcmrl_data
from tcmrl_data import Recipe, load_recipe
from tcmrl_data.behavior.base import CheckpointFolder, TrainingState
from tcmrl_data.building.plan import UnitSpec, plan_build, run_unit
from tcmrl_data.building.work_files import STATUS, BuildEvent
from tcmrl_data.engine.base import BaseEngine, Message, Result, Unit
from tcmrl_data.foundation.disk import CHECKPOINTS
from tcmrl_data.foundation.records import digest, to_json
from tests.conftest import TINY
from tests.datasets import part_ids
from tests.platforms import AVX2
from tests.training_of_behavior import Digests, Interrupted, assert_resumes, context_of, digests
from tests.workers import PATIENCE, command_line, wait_for, worker_pids

pytestmark = pytest.mark.usefixtures("module_in_process")


def folder(
    dataset: Path,
    *,
    key: str = "k",
    missing: Mapping[int, int] = MappingProxyType({}),
    seconds: float = 0.0,
    warn: Callable[[str], None] = print,
) -> CheckpointFolder:
    return CheckpointFolder(dataset, "task", key=key, missing=missing, seconds=seconds, warn=warn)


HOPPER = (*TINY, "behavior.sac.steps=300", "behavior.sac.snapshots=[0,200,300]")


@pytest.mark.parametrize(
    ("name", "overrides", "stop_at"),
    [
        ("point-robot", TINY, 30),
        ("point-robot", TINY, 130),
        ("hopper-rand-params", HOPPER, 250),
        ("point-robot", (*TINY, "behavior.sac.buffer_size=40", "behavior.sac.entropy=0.1"), 130),
    ],
)
def test_a_resumed_training_equals_an_uninterrupted_one(
    tmp_path: Path, name: str, overrides: tuple[str, ...], stop_at: int
) -> None:
    recipe = load_recipe(name, profile="quick", overrides=overrides)
    assert_resumes(recipe, [2], tmp_path, stop_at=stop_at)


LATER = ("behavior.sac.steps=2000", "behavior.sac.snapshots=[0,100,2000]")


@pytest.fixture
def ending() -> Iterator[None]:
    """SIGTERM raises, as in a worker."""

    def end(number: int, frame: FrameType | None) -> None:
        raise Interrupted

    earlier = signal.signal(signal.SIGTERM, end)
    yield
    signal.signal(signal.SIGTERM, earlier)


@pytest.mark.usefixtures("ending")
@pytest.mark.parametrize("source", ["sac", "stacked"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_leaves_a_checkpoint_of_the_training(
    source: str, number: signal.Signals, tmp_path: Path
) -> None:
    """No checkpoint is due by time; SIGTERM ends the training behind it, SIGUSR1 does not."""
    overrides = [*TINY, f"behavior.source={source}", *LATER]
    recipe = load_recipe("point-robot", profile="quick", overrides=overrides)
    straight = digests(recipe, context_of(recipe, [2], tmp_path / "straight"))
    steps = 0

    def report(count: int) -> None:
        nonlocal steps
        steps += count
        if steps - count < 250 <= steps:
            signal.raise_signal(number)

    told = dataclasses.replace(context_of(recipe, [2], tmp_path), report=report)
    made: Digests = {}
    try:
        for task, snapshot in recipe.make_source().snapshots(told):
            made[task.index, snapshot.step] = snapshot.digest()
    except Interrupted:
        assert number == signal.SIGTERM and set(made) == {(2, 0), (2, 100)}
    else:
        assert number == signal.SIGUSR1 and made == straight
    context = context_of(recipe, [2], tmp_path)
    state = context.checkpoints(context.tasks).load()
    assert state is not None and 250 <= state.values["steps"] < 2_000
    later = digests(recipe, context)
    assert made | later == straight and set(later) == {(2, 2_000)}


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[], Path]:
    def save() -> Path:
        folder(tmp_path).save(TrainingState({"steps": 10}, {"weights": np.arange(4.0)}))
        return tmp_path

    return save


def test_the_last_checkpoint_comes_back_and_replaces_the_others(saved: Callable[[], Path]) -> None:
    dataset = saved()
    folder(dataset).save(TrainingState({"steps": 20}, {"weights": np.arange(4.0)}))
    state = folder(dataset).load()
    assert state is not None
    assert state.values == {"steps": 20}
    assert np.array_equal(state.arrays["weights"], np.arange(4.0))
    assert len(list((dataset / CHECKPOINTS / "task").iterdir())) == 1
    folder(dataset).clear()
    assert folder(dataset).load() is None


@pytest.mark.parametrize("change", [{"key": "other recipe"}, {"missing": {2: 10}}])
def test_a_checkpoint_of_other_settings_or_past_a_missing_part_is_ignored(
    saved: Callable[[], Path], change: dict[str, object]
) -> None:
    assert folder(saved(), **change).load() is None  # type: ignore[arg-type]


def test_a_failed_task_lacks_no_snapshot_after_its_failure(tmp_path: Path) -> None:
    values = {"steps": 10, "failed": {"2": 10}}
    folder(tmp_path).save(TrainingState(values, {"weights": np.zeros(2)}))
    assert folder(tmp_path, missing={2: 10, 3: 20}).load() is not None
    for missing in ({2: 5}, {2: 10, 3: 10}):  # a part that was lost, and a task that has not failed
        assert folder(tmp_path, missing=missing).load() is None


def test_a_checkpoint_that_cannot_be_written_is_reported_once_and_tried_again(tmp_path: Path) -> None:
    (tmp_path / CHECKPOINTS).touch()  # where the folder must go
    warnings: list[str] = []
    checkpoints = folder(tmp_path, warn=warnings.append)
    for step in (10, 20):
        checkpoints.save(TrainingState({"steps": step}, {"weights": np.zeros(2)}))
    assert len(warnings) == 1
    assert warnings[0].startswith(f"training goes on without a new checkpoint: cannot write {tmp_path}")
    (tmp_path / CHECKPOINTS).unlink()
    checkpoints.save(TrainingState({"steps": 30}, {"weights": np.zeros(2)}))
    state = checkpoints.load()
    assert state is not None
    assert state.values["steps"] == 30


def test_a_unit_that_can_write_no_checkpoint_is_done_nevertheless(
    tiny_folder: Path, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CheckpointFolder, "is_due", lambda self: True)
    plan = plan_build(tiny_recipe, tasks=[3])
    (tmp_path / CHECKPOINTS).touch()
    messages: list[Mapping[str, Any]] = []
    made = run_unit(UnitSpec(tmp_path, plan), messages.append)
    expected = [part_id for (task, _), part_id in part_ids(tiny_folder).items() if task == 3]
    assert made == digest(expected)
    assert [message["kind"] for message in messages].count("warning") == 1


def test_the_warning_of_a_unit_reaches_the_record_and_the_user(tiny_recipe: Recipe, tmp_path: Path) -> None:
    class Engine(BaseEngine):
        def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
            on_message(units[0].id, {"kind": "warning", "message": "the disk is full"})
            yield Result(units[0].id, False, None, "ended", 1, "here")

    seen: list[BuildEvent] = []
    tcmrl_data.build_dataset(tiny_recipe, tmp_path / "out", tasks=[3], engine=Engine(), progress=seen.append)
    assert [event.message for event in seen if event.kind == "warning"] == ["task 3: the disk is full"]
    assert '"task 3: the disk is full"' in (tmp_path / "out" / STATUS).read_text()


SAVE_OR_LOAD = """
import json, sys
import numpy as np
from tcmrl_data.behavior.base import TrainingState
from tcmrl_data.building.plan import UnitSpec, _checkpoints
from tcmrl_data.foundation.records import from_json
spec = from_json(UnitSpec, json.loads(sys.argv[2]))
plan = spec.plan
checkpoints = _checkpoints(spec, plan.tasks, {3: plan.source.steps}, print)
if sys.argv[1] == "save":
    checkpoints.save(TrainingState({"steps": -1}, {"weights": np.zeros(2)}))  # before snapshot 0
print(checkpoints.load() is not None)
"""


@pytest.mark.check
def test_a_checkpoint_of_another_platform_is_ignored(tiny_recipe: Recipe, tmp_path: Path) -> None:
    spec = json.dumps(to_json(UnitSpec(tmp_path, plan_build(tiny_recipe, tasks=[3]))))
    found = [
        subprocess.run(
            [sys.executable, "-c", SAVE_OR_LOAD, command, spec],
            env=os.environ | variables,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for command, variables in (("save", AVX2), ("load", AVX2), ("load", {}))
    ]
    assert found == ["True", "True", "False"]


def test_a_damaged_checkpoint_is_ignored(saved: Callable[[], Path]) -> None:
    dataset = saved()
    (file,) = (dataset / CHECKPOINTS / "task").iterdir()
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    assert folder(dataset).load() is None


STEPS = 1_500
LONG = (
    *TINY,
    f"behavior.sac.steps={STEPS}",
    f"behavior.sac.snapshots=[0,{STEPS}]",
    "behavior.sac.train_frequency=1",
)
"""Two parts alone: what lies between them is kept by checkpoints, possible every 100 steps, or not at all."""


def long_build(out: Path, checkpoint_every: float) -> list[str]:
    settings = [argument for override in LONG for argument in ("--set", override)]
    command = ["build", "point-robot", "--profile", "quick", *settings, "--tasks", "3", "--workers", "1"]
    return [*command, "--checkpoint-every", str(checkpoint_every), "--out", str(out)]


def saved_steps(out: Path) -> int:
    """Steps of the newest checkpoint of a build; 0 where there is none."""
    for file in out.glob(f"{CHECKPOINTS}/*/*.safetensors"):
        with contextlib.suppress(OSError, ValueError):
            data = file.read_bytes()
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            return int(json.loads(header["__metadata__"]["state"])["values"]["steps"])
    return 0


@pytest.fixture(scope="module")
def long_ids(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, int], str]:
    """The parts of a build that nobody stops."""
    out = tmp_path_factory.mktemp("straight")
    tcmrl_data.build_dataset(load_recipe("point-robot", profile="quick", overrides=LONG), out, tasks=[3])
    return part_ids(out)


@pytest.mark.check
def test_a_build_killed_after_every_second_checkpoint_ends_in_the_same_parts(
    long_ids: dict[tuple[int, int], str], mark: str, tmp_path: Path
) -> None:
    out, kept = tmp_path / "data", [0]
    for _ in range(2):
        with command_line(*long_build(out, 0)) as driver:
            seen = {kept[-1]}

            def has_saved_twice() -> bool:
                seen.add(saved_steps(out))  # noqa: B023
                return len(seen) > 2 or driver.poll() is not None  # noqa: B023

            wait_for(has_saved_twice, "two checkpoints")
            assert driver.poll() is None
            for pid in worker_pids(mark):
                os.kill(pid, signal.SIGKILL)
            driver.kill()
        wait_for(lambda: not worker_pids(mark), "the end of the workers")
        kept.append(saved_steps(out))
    assert kept == sorted(set(kept)) and kept[-1] < STEPS  # every start went on from the checkpoint before
    with command_line(*long_build(out, 0)) as driver:
        _, errors = driver.communicate(timeout=PATIENCE)
    assert (driver.returncode, part_ids(out)) == (0, long_ids), errors


@pytest.mark.check
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_build_leaves_a_checkpoint_of_its_training(
    number: signal.Signals, long_ids: dict[tuple[int, int], str], tmp_path: Path
) -> None:
    """None was due by time."""
    out = tmp_path / "data"
    with command_line(*long_build(out, 3_600)) as driver:
        wait_for(lambda: status_steps(out) > 0 or driver.poll() is not None, "training")
        driver.send_signal(number)
        _, errors = driver.communicate(timeout=PATIENCE)
    assert driver.returncode == 1, errors
    assert 0 < saved_steps(out) < STEPS
    with command_line(*long_build(out, 3_600)) as driver:
        _, errors = driver.communicate(timeout=PATIENCE)
    assert (driver.returncode, part_ids(out)) == (0, long_ids), errors


def status_steps(out: Path) -> int:
    """Steps of training that the build has recorded."""
    steps: int = json.loads((out / STATUS).read_text())["steps_done"] if (out / STATUS).is_file() else 0
    return steps
