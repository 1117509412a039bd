"""`status.json`: how far a build is, for anyone who asks."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tcmrl_cli.data import data

from tcmrl_data import build_status, collect_garbage
from tcmrl_data.building import work_files
from tcmrl_data.building.work_files import MAX_MESSAGES, STATUS, BuildEvent, StatusFile
from tcmrl_data.foundation.disk import LOCK, lock_file
from tests.commands import run
from tests.conftest import TINY
from tests.directed import Directions
from tests.workers import PATIENCE, command_line

Copy = Callable[[], Path]


def event(kind: str, unit: str | None = None, steps: int = 0, message: str = "") -> BuildEvent:
    return BuildEvent(kind, unit, 0, 15, steps, 750, message)  # type: ignore[arg-type]


def test_a_finished_build_says_so(tiny_folder: Path) -> None:
    status = build_status(tiny_folder)
    assert (status.complete, status.parts_done, status.parts_total) == (True, 15, 15)
    assert (status.builder, status.running, status.failed) == (None, (), ())
    assert status.updated is not None


def stop_the_clock(patch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Stops the clock of the status; returns a function that sets it to a second."""
    now = [1000.0]
    patch.setattr(work_files.time, "time", lambda: now[0])
    return lambda second: now.__setitem__(0, 1000.0 + second)


def test_running_failed_and_rate_are_those_of_the_latest_build(
    tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    events = [
        event("start"),
        event("steps", "task 7", 10),
        event("steps", "task 8", 50),
        event("part", "task 8"),
        event("unit_failed", "task 7", 100, "task 7 failed: why"),
        event("steps", "task 8", 350),
    ]
    set_clock, file = stop_the_clock(monkeypatch), StatusFile(folder)
    for number, entry in enumerate(events):
        set_clock(10.0 * number)
        file.write(entry)
    idle = build_status(folder)
    assert (idle.builder, idle.running, idle.failed) == (None, (), ("task 7 failed: why",))
    assert (idle.steps_per_second, idle.updated) == (None, 1050.0)
    with lock_file(folder / LOCK, "dataset"):
        busy = build_status(folder)
    assert busy.builder == f"process {os.getpid()} on {os.uname().nodename}"
    assert (busy.running, busy.steps_per_second, busy.seconds_left) == (("task 8",), 7.0, 400 / 7.0)
    StatusFile(folder).write(event("start"))
    assert build_status(folder).failed == ()
    assert collect_garbage(folder) == ()


def test_the_rate_is_that_of_the_latest_minute(tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tiny_copy()
    set_clock, file = stop_the_clock(monkeypatch), StatusFile(folder)
    for second in range(200):
        set_clock(second)
        file.write(event("steps", "task 1", 3 * second if second < 100 else 300 + (second - 100)))
    with lock_file(folder / LOCK, "dataset"):
        assert build_status(folder).steps_per_second == 1.0


def test_steps_are_written_at_most_once_a_second_but_all_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[BuildEvent] = []
    set_clock, file, written = stop_the_clock(monkeypatch), StatusFile(tmp_path, reported.append), set()
    for steps in range(50):
        set_clock(steps / 10)
        file.write(event("steps", "task 1", steps))
        written.add(json.loads((tmp_path / STATUS).read_text())["steps_done"])
    assert len(reported) == 50
    assert written == {0, 10, 20, 30, 40}


@pytest.mark.check
def test_status_of_a_running_build_from_another_process(tmp_path: Path) -> None:
    out, directions = tmp_path / "running", Directions(str(tmp_path / "directions")).hold()
    options = ["--profile", "quick", "--tasks", "0,3", "--workers", "1", "--quiet", "--out", str(out)]
    options += [word for override in TINY for word in ("--set", override)]
    with command_line("build", "point-robot", *options, directions=directions) as builder:
        directions.wait(builder)
        with command_line("show", str(out), "--json") as asker:
            document = json.loads(asker.communicate(timeout=PATIENCE)[0])["build"]
        assert document["builder"].startswith(f"process {builder.pid} on ")
        assert document["running"] == ["task 0"]
        assert document["parts_total"] == 6
        directions.release()
        assert builder.wait(PATIENCE) == 0
    assert build_status(out).complete


def test_of_many_failures_the_latest_are_listed_and_all_counted(
    tiny_copy: Copy, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tiny_copy()
    file = StatusFile(folder)
    file.write(event("start"))
    for task in range(MAX_MESSAGES + 20):
        file.write(event("unit_failed", f"task {task}", 0, f"task {task} failed: {'why ' * 1_000}"))
    status = build_status(folder)
    assert (len(status.failed), status.num_failed) == (MAX_MESSAGES, MAX_MESSAGES + 20)
    assert status.failed[-1].startswith(f"task {MAX_MESSAGES + 19} failed")
    assert run(data, ["show", str(folder)]) == 0
    assert "120 units, the latest 100: " in capsys.readouterr().out


@pytest.mark.parametrize(
    "change", [{"running": [1]}, {"num_failed": True}, {"time": "x"}, {"other": 1}, None]
)
def test_a_damaged_status_says_nothing(tiny_copy: Copy, change: dict[str, object] | None) -> None:
    folder = tiny_copy()
    written = json.loads((folder / STATUS).read_text())
    assert build_status(folder).updated == written["time"]
    (folder / STATUS).write_text("[" * 9999 if change is None else json.dumps(written | change))
    assert build_status(folder).updated is None
