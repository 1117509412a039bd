"""The record of a build: `events.jsonl` in the dataset, written as it goes on, read by anyone at any time."""

import dataclasses
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tcmrl_data.foundation.disk import LOCK, lock_holder, named_errors
from tcmrl_data.store.manifest import dataset_folder, read_manifest

EVENTS = "events.jsonl"
STEPS_SECONDS = 1.0
"""Progress within a unit is recorded at most this often."""

TAIL_BYTES = 2**20
"""A reader takes every event of the record's end, and before it only how builds began and units ended."""

RECORD_BYTES = 2**30
"""A reader looks at no more than this; a day of building writes about 30 MB."""

LINE_BYTES = 2**16
MILESTONES = tuple(f'"kind": "{kind}"'.encode() for kind in ("start", "unit_done", "unit_failed"))

EventKind = Literal["start", "steps", "part", "unit_done", "unit_failed", "end"]


@dataclass(frozen=True)
class BuildEvent:
    """How far a build is.

    Attributes:
        kind: what just happened.
        unit: to which unit.
        steps_done: environment steps of behavior training, resumed ones included.
        message: for people.
    """

    kind: EventKind
    unit: str | None
    tasks_done: int
    tasks_total: int
    parts_done: int
    parts_total: int
    steps_done: int
    steps_total: int
    message: str


class EventLog:
    """Appends events to a dataset's record and passes them on; a context manager.

    A line is one write, so that readers never see half of one; the record is no part of the data and is
    not forced to disk.
    """

    def __init__(self, dataset: Path, progress: Callable[[BuildEvent], None]) -> None:
        self._progress, self._path = progress, dataset / EVENTS
        self._steps_written = 0.0

    def __enter__(self) -> "EventLog":
        self._file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        return self

    def __exit__(self, *exception: object) -> None:
        os.close(self._file)

    def write(self, event: BuildEvent) -> None:
        """Records an event and reports it."""
        now = time.time()
        if event.kind != "steps" or now - self._steps_written >= STEPS_SECONDS:
            line = {"time": round(now, 3), "process": os.getpid(), **dataclasses.asdict(event)}
            with named_errors(self._path):
                os.write(self._file, json.dumps(line).encode() + b"\n")
            self._steps_written = now if event.kind == "steps" else self._steps_written
        self._progress(event)


@dataclass(frozen=True)
class BuildStatus:
    """What a dataset's manifest, lock and record say of its build.

    Attributes:
        builder: the process that builds it now; null where none does.
        running: units at work, as far as the record tells.
        failed: one line per unit that failed in the latest build.
        steps_per_second: environment steps of behavior training, over the latest minute of the record.
        seconds_left: at that rate; null where nothing is known.
        updated: Unix time of the latest event.
    """

    dataset: str
    environment: str
    complete: bool
    tasks: int
    parts_done: int
    parts_total: int
    builder: str | None
    running: tuple[str, ...]
    failed: tuple[str, ...]
    steps_per_second: float | None
    seconds_left: float | None
    updated: float | None


def build_status(dataset: Path) -> BuildStatus:
    """How far the build of a dataset is; may be asked while it runs, from any process.

    Raises:
        ManifestError: there is no dataset.
    """
    folder = dataset_folder(dataset)
    manifest = read_manifest(folder)
    builder = lock_holder(folder / LOCK)
    events = _latest_build(folder / EVENTS)
    rate = _rate(events)
    last = events[-1] if events else None
    left = (last["steps_total"] - last["steps_done"]) / rate if last and rate and builder else None
    return BuildStatus(
        dataset=str(folder),
        environment=manifest.name,
        complete=manifest.complete,
        tasks=len(manifest.tasks),
        parts_done=len(manifest.parts),
        parts_total=len(manifest.tasks) * len(manifest.steps),
        builder=builder,
        running=_running(events) if builder else (),
        failed=tuple(event["message"] for event in events if event["kind"] == "unit_failed"),
        steps_per_second=rate if builder else None,
        seconds_left=left,
        updated=last["time"] if last else None,
    )


def _latest_build(path: Path) -> list[dict[str, Any]]:
    """Events since the last `start`; lines that are no events are passed over."""
    fields = {field.name for field in dataclasses.fields(BuildEvent)} | {"time", "process"}
    events: list[dict[str, Any]] = []
    for line in _lines(path):
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(event, dict) and set(event) == fields and _is_well_typed(event):
            if event["kind"] == "start":
                events.clear()
            events.append(event)
    return events


def _lines(path: Path) -> Iterator[bytes]:
    """The last lines of the record, and before them those that tell of milestones."""
    if not path.is_file() or path.is_symlink():
        return
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - RECORD_BYTES))
        while line := file.readline(LINE_BYTES):
            if file.tell() > size - TAIL_BYTES or any(mark in line for mark in MILESTONES):
                yield line


def _is_well_typed(event: dict[str, Any]) -> bool:
    """True if texts are str and numbers are bounded int or float, not bool; the file may be damaged."""
    texts = [event["kind"], event["message"], event["unit"] or ""]
    numbers = [value for name, value in event.items() if name not in ("kind", "message", "unit")]
    return all(isinstance(text, str) for text in texts) and all(
        type(number) in (int, float) and abs(number) < 2**63 for number in numbers
    )


def _rate(events: list[dict[str, Any]]) -> float | None:
    if not events:
        return None
    recent = [event for event in events if event["time"] >= events[-1]["time"] - 60.0]
    seconds = recent[-1]["time"] - recent[0]["time"]
    steps = recent[-1]["steps_done"] - recent[0]["steps_done"]
    return float(steps / seconds) if seconds > 0 and steps > 0 else None


def _running(events: list[dict[str, Any]]) -> tuple[str, ...]:
    running: dict[str, None] = {}
    for event in events:
        if event["kind"] in ("unit_done", "unit_failed"):
            running.pop(event["unit"], None)
        elif event["unit"]:
            running[event["unit"]] = None
    return tuple(running)
