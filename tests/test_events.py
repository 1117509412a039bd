import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tcmrl_data import build_status
from tcmrl_data.build import events
from tcmrl_data.build.events import EVENTS, TAIL_BYTES, BuildEvent, EventLog
from tcmrl_data.foundation.disk import LOCK, lock_file
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


def test_failures_are_remembered_however_long_the_build_goes_on(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    with EventLog(folder, lambda _: None) as log:
        log.write(event("start"))
        log.write(event("unit_failed", "task 7", 100, "task 7 failed: why"))
    line = (folder / EVENTS).read_text().splitlines()[-1]
    later = json.dumps(json.loads(line) | {"kind": "steps", "unit": "task 8", "message": "task 8"})
    with (folder / EVENTS).open("a") as file:
        file.write(f"{later}\n" * (2 * TAIL_BYTES // len(later)))
    assert build_status(folder).failed == ("task 7 failed: why",)
