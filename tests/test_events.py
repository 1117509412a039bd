import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tcmrl_cli.data import data

from tcmrl_data import build_status, collect_garbage
from tcmrl_data.building import events
from tcmrl_data.building.events import EARLIER_EVENTS, EVENTS, MAX_FAILURES, BuildEvent, EventLog
from tcmrl_data.foundation.disk import LOCK, lock_file
from tcmrl_data.store.manifest import MANIFEST
from tests.commands import run
from tests.conftest import TINY
from tests.directed import Directions
from tests.workers import PATIENCE, command_line

Copy = Callable[[], Path]


def event(kind: str, unit: str | None = None, steps: int = 0, message: str = "") -> BuildEvent:
    return BuildEvent(kind, unit, 0, 5, 0, 15, steps, 750, message)  # type: ignore[arg-type]


def test_a_finished_build_says_so(tiny_folder: Path) -> None:
    status = build_status(tiny_folder)
    assert (status.complete, status.parts_done, status.parts_total) == (True, 15, 15)
    assert (status.builder, status.running, status.failed) == (None, (), ())
    kinds = [json.loads(line)["kind"] for line in (tiny_folder / EVENTS).read_text().splitlines()]
    assert (kinds[0], kinds[-1], kinds.count("part"), kinds.count("unit_done")) == ("start", "end", 15, 5)


def stop_the_clock(patch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Stops the clock of the record; returns a function that sets it to a second."""
    now = [1000.0]
    patch.setattr(events.time, "time", lambda: now[0])
    return lambda second: now.__setitem__(0, 1000.0 + second)


def test_running_failed_and_rate_come_from_the_latest_build(
    tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    lines = [
        event("start"),
        event("steps", "task 7", 10),
        event("steps", "task 8", 50),
        event("part", "task 8"),
    ]
    lines += [event("unit_failed", "task 7", 100, "task 7 failed: why"), event("steps", "task 9", 150)]
    stop_the_clock(monkeypatch)
    with EventLog(folder, lambda _: None) as log:
        for entry in lines:
            log.write(entry)
    rewritten = []
    for second, line in enumerate((folder / EVENTS).read_text().splitlines()):
        rewritten.append(json.dumps(json.loads(line) | {"time": 1000.0 + 10 * second}))
    torn = rewritten[-1][: len(rewritten[-1]) // 2]
    (folder / EVENTS).write_text("\n".join([*rewritten, torn, "[" * 9999, "3"]) + "\n")
    idle = build_status(folder)
    assert (idle.builder, idle.running, idle.failed) == (None, (), ("task 7 failed: why",))
    with lock_file(folder / LOCK, "dataset"):
        busy = build_status(folder)
    assert busy.builder == f"process {os.getpid()} on {os.uname().nodename}"
    assert busy.running == ("task 8",)
    assert busy.steps_per_second is not None
    assert busy.seconds_left is not None


def test_steps_are_recorded_at_most_once_a_second_but_all_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[BuildEvent] = []
    set_clock = stop_the_clock(monkeypatch)
    with EventLog(tmp_path, reported.append) as log:
        for steps in range(50):
            set_clock(steps / 10)
            log.write(event("steps", "task 1", steps))
    assert len(reported) == 50
    recorded = [json.loads(line)["steps_done"] for line in (tmp_path / EVENTS).read_text().splitlines()]
    assert recorded == [0, 10, 20, 30, 40]


@pytest.mark.check
def test_status_of_a_running_build_from_another_process(tmp_path: Path) -> None:
    out, directions = tmp_path / "running", Directions(str(tmp_path / "directions")).hold()
    options = ["--profile", "quick", "--tasks", "0,3", "--workers", "1", "--quiet", "--out", str(out)]
    options += [word for override in TINY for word in ("--set", override)]
    with command_line("build", "point-robot", *options, directions=directions) as builder:
        directions.wait(builder)
        with command_line("status", str(out), "--json") as asker:
            document = json.loads(asker.communicate(timeout=PATIENCE)[0])
        assert document["builder"].startswith(f"process {builder.pid} on ")
        assert document["running"] == ["task 0"]
        assert document["parts_total"] == 6
        directions.release()
        assert builder.wait(PATIENCE) == 0
    assert build_status(out).complete


def test_failures_are_remembered_however_long_the_build_goes_on(
    tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    monkeypatch.setattr(events, "EVENTS_BYTES", 20_000)
    with EventLog(folder, lambda _: None) as log:
        log.write(event("start"))
        log.write(event("unit_failed", "task 7", 100, "task 7 failed: why"))
        for _ in range(400):
            log.write(event("part", "task 8"))
    assert "task 7" not in (folder / EARLIER_EVENTS).read_text().partition("\n")[2]
    status = build_status(folder)
    assert (status.failed, status.num_failed) == (("task 7 failed: why",), 1)
    assert collect_garbage(folder) == ()


@dataclass(frozen=True)
class Step:
    """An event and the seconds since the one before."""

    kind: str
    unit: str | None
    seconds: float
    steps: int


STEPS = st.builds(
    Step,
    kind=st.sampled_from(["start", *["steps", "part", "unit_done", "unit_failed"] * 8, "end"]),
    unit=st.sampled_from([None, "task 1", "task 2", "3 tasks from 4 to 6"]),
    seconds=st.sampled_from([0.0, 0.3, 1.0, 7.5, 100.0]),
    steps=st.integers(0, 500),
)


@pytest.mark.check
@settings(max_examples=30)
@given(steps=st.lists(STEPS, min_size=60, max_size=90))
def test_a_status_is_the_same_however_often_the_record_was_rotated(
    tiny_folder: Path, steps: list[Step]
) -> None:
    """Also between rotations, and while a reader finds the earlier file alone."""
    limit, told = 5_000, []
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as temporary:
        folders = [Path(temporary) / "rotated", Path(temporary) / "whole"]
        for folder in folders:
            folder.mkdir()
            shutil.copy(tiny_folder / MANIFEST, folder)
            patch.setattr(events, "EVENTS_BYTES", limit if folder == folders[0] else 2**30)
            set_clock, now, done = stop_the_clock(patch), 0.0, 0
            statuses = []
            with lock_file(folder / LOCK, "dataset"), EventLog(folder, lambda _: None) as log:
                for number, step in enumerate(steps):
                    now, done = now + step.seconds, done + step.steps
                    set_clock(now)
                    log.write(event(step.kind, step.unit, done, f"{step.unit} {step.kind} {number}"))
                    if number % 10 == 0 or number == len(steps) - 1:
                        statuses.append(dataclasses.replace(build_status(folder), dataset=""))
            told.append(statuses)
            sizes = [file.stat().st_size for file in folder.glob("events*")]
            assert (len(sizes), max(sizes) <= limit) == ((2, True) if folder == folders[0] else (1, False))
    assert told[0] == told[1]


def test_while_the_record_is_rotated_the_earlier_file_answers(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    before = build_status(folder)
    assert before.updated is not None
    (folder / EVENTS).rename(folder / EARLIER_EVENTS)
    assert build_status(folder) == before


def test_a_build_after_one_that_ended_within_a_line_is_read(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    with EventLog(folder, lambda _: None) as log:
        log.write(event("start"))
        log.write(event("unit_failed", "task 7", 100, "task 7 failed: why"))
    with (folder / EVENTS).open("a") as file:
        file.write('{"time": 12')
    with EventLog(folder, lambda _: None) as log:
        log.write(event("start"))
    assert build_status(folder).failed == ()


def test_of_many_failures_the_latest_are_listed_and_all_counted(
    tiny_copy: Copy, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tiny_copy()
    with EventLog(folder, lambda _: None) as log:
        log.write(event("start"))
        for task in range(MAX_FAILURES + 20):
            log.write(event("unit_failed", f"task {task}", 0, f"task {task} failed: {'why ' * 1_000}"))
    status = build_status(folder)
    assert (len(status.failed), status.num_failed) == (MAX_FAILURES, MAX_FAILURES + 20)
    assert status.failed[-1].startswith(f"task {MAX_FAILURES + 19} failed")
    assert run(data, ["status", str(folder)]) == 0
    assert "120 units; these are the latest 100" in capsys.readouterr().out


@pytest.mark.parametrize(
    "summary",
    [
        None,
        [],
        {"running": [1], "failed": [], "num_failed": 0, "paces": []},
        {"running": [], "failed": "text", "num_failed": 0, "paces": []},
        {"running": [], "failed": [], "num_failed": True, "paces": []},
        {"running": [], "failed": [], "num_failed": 0, "paces": [[1]]},
        {"running": [], "failed": [], "num_failed": 0, "paces": [["1", 2]]},
        {"running": [], "failed": [], "num_failed": 0},
    ],
)
def test_a_damaged_summary_is_passed_over(tiny_copy: Copy, summary: object) -> None:
    folder = tiny_copy()
    before = build_status(folder)
    line = json.loads((folder / EVENTS).read_text().splitlines()[-1])
    with (folder / EVENTS).open("a") as file:
        file.write(json.dumps(line | {"kind": "rotated", "time": 1, "summary": summary}) + "\n")
    assert build_status(folder) == before
