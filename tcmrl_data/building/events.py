"""The record of a build: `events.jsonl` in the dataset, written as it goes on, read by anyone at any time.

The record is two files of at most EVENTS_BYTES each. When `events.jsonl` is full it becomes `events.1.jsonl`,
the earlier one goes, and a new one begins with a line of kind `rotated` that sums up the latest build so far.
A status therefore needs `events.jsonl` alone, and never reads more than EVENTS_BYTES.
"""

import dataclasses
import json
import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    lock_holder,
    make_own,
    move_into_place,
    named_errors,
    replace_file,
)
from tcmrl_data.foundation.plain_files import read_plain_file
from tcmrl_data.store.manifest import Manifest, dataset_folder, read_manifest

EVENTS = "events.jsonl"
EARLIER_EVENTS = "events.1.jsonl"
EVENTS_BYTES = 2 * 2**20
"""Maximum size of each of the two files; both together hold about four hours of building."""

STEPS_SECONDS = 1.0
"""Progress within a unit is recorded at most this often."""

MESSAGE_CHARACTERS = 1_000
"""A longer message is cut in the record."""

WINDOW_SECONDS = 60
"""Training speed is measured over this time."""

MAX_FAILURES = 100
MAX_RUNNING = 10_000
"""Of more failed or running units the latest are remembered."""

EventKind = Literal["start", "steps", "part", "warning", "unit_done", "unit_failed", "end"]


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


TEXTS = frozenset({"kind", "message", "unit"})
NUMBERS = frozenset({"time", "process", *(field.name for field in dataclasses.fields(BuildEvent))}) - TEXTS
FIELDS = NUMBERS | TEXTS
"""Of a line of the record."""


@final
class History:
    """The latest build, from its events in order; equal before and after it was summed up.

    Attributes:
        running: ids of the units at work, in the order of their first events.
        failed: messages of the latest failed units.
        num_failed: how many units failed.
        last: the latest event; None before the first.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.running: dict[str, None] = {}
        self.failed: deque[str] = deque(maxlen=MAX_FAILURES)
        self.num_failed = 0
        self.last: Mapping[str, Any] | None = None
        self._paces: dict[int, tuple[float, int]] = {}  # second: time and steps of its first event

    def add(self, event: Mapping[str, Any]) -> None:
        """Adds the next event of the record, or a summary of all events before."""
        kind, unit = event["kind"], event["unit"]
        if kind == "rotated":
            self._restore(event["summary"])
        elif kind == "start":
            self._clear()
        elif kind in ("unit_done", "unit_failed"):
            self.running.pop(unit, None)
        elif unit:
            self.running[unit] = None
            if len(self.running) > MAX_RUNNING:
                del self.running[next(iter(self.running))]
        if kind == "unit_failed":
            self.failed.append(event["message"])
            self.num_failed += 1
        self.last = event
        self._measure(event["time"], event["steps_done"])

    def _measure(self, time: float, steps: int) -> None:
        now = int(time)
        if now not in self._paces:
            self._paces[now] = (time, steps)
            self._paces = {
                second: pace for second, pace in self._paces.items() if 0 <= now - second <= WINDOW_SECONDS
            }

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps of behavior training over the latest minute; None if there were none."""
        if self.last is None:
            return None
        time, steps = self._paces[min(self._paces)]
        seconds, steps = self.last["time"] - time, self.last["steps_done"] - steps
        return float(steps / seconds) if seconds > 0 and steps > 0 else None

    def summary(self) -> dict[str, Any] | None:
        """An event that stands for all events so far; None if there were none."""
        if self.last is None:
            return None
        summary = {
            "running": list(self.running),
            "failed": list(self.failed),
            "num_failed": self.num_failed,
            "paces": list(self._paces.values()),
        }
        return {**self.last, "kind": "rotated", "unit": None, "message": "", "summary": summary}

    def _restore(self, summary: Mapping[str, Any]) -> None:
        self._clear()
        self.running = dict.fromkeys(summary["running"])
        self.failed.extend(summary["failed"])
        self.num_failed = summary["num_failed"]
        self._paces = {int(time): (time, steps) for time, steps in summary["paces"]}


def is_summary(value: object) -> bool:
    """True if a value read from a file is what `History.summary` writes; the file may be damaged."""
    if not isinstance(value, dict) or set(value) != {"running", "failed", "num_failed", "paces"}:
        return False
    texts = [value["running"], value["failed"]]
    return (
        all(isinstance(list_, list) and all(isinstance(text, str) for text in list_) for list_ in texts)
        and is_number(value["num_failed"])
        and isinstance(value["paces"], list)
        and all(isinstance(pace, list) and len(pace) == 2 for pace in value["paces"])
        and all(is_number(number) for pace in value["paces"] for number in pace)
    )


def is_number(value: object) -> bool:
    """True for a bounded int or float that is not NaN; a bool is no number."""
    return type(value) in (int, float) and abs(value) < 2**63  # type: ignore[arg-type]


class EventLog:
    """Appends events to a dataset's record and passes them on; a context manager.

    A line is one write, so that readers never see half of one; the record is no part of the data and is
    not forced to disk.
    """

    def __init__(self, dataset: Path, progress: Callable[[BuildEvent], None] | None = None) -> None:
        self._progress, self._dataset, self._path = progress, dataset, dataset / EVENTS
        self._steps_written = 0.0
        self._history = History()

    def __enter__(self) -> "EventLog":
        self._open()
        return self

    def __exit__(self, *exception: object) -> None:
        os.close(self._file)

    def write(self, event: BuildEvent) -> None:
        """Records an event and reports it.

        Raises:
            StorageError: the operating system refuses the operation.
        """
        now = time.time()
        if event.kind != "steps" or now - self._steps_written >= STEPS_SECONDS:
            line = {"time": round(now, 3), "process": os.getpid(), **dataclasses.asdict(event)}
            line["message"] = event.message[:MESSAGE_CHARACTERS]
            self._append(line)
            self._steps_written = now if event.kind == "steps" else self._steps_written
        if self._progress is not None:
            self._progress(event)

    def _append(self, line: Mapping[str, Any]) -> None:
        data = _encode(line)
        if self._size and self._size + len(data) > EVENTS_BYTES:
            self._rotate()
        with named_errors(self._path):
            os.write(self._file, data)
        self._size += len(data)
        self._history.add(line)

    def _rotate(self) -> None:
        """Starts a new file; a reader that finds none meanwhile takes the earlier one."""
        full, summary = self._file, self._history.summary()
        if self._path.exists():  # not if an earlier attempt failed in between
            move_into_place(self._path, self._dataset / EARLIER_EVENTS)
        replace_file(self._path, _encode(summary) if summary else b"", staging=self._dataset / STAGING)
        self._open()
        os.close(full)

    def _open(self) -> None:
        make_own(self._path, num_bytes=EVENTS_BYTES, staging=self._dataset / STAGING)
        self._file = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        self._size = os.fstat(self._file).st_size
        if self._size and os.pread(self._file, 1, self._size - 1) != b"\n":
            self._size += os.write(self._file, b"\n")  # a process ended, or the disk was full, within a line


def _encode(line: Mapping[str, Any]) -> bytes:
    return json.dumps(line).encode() + b"\n"


@dataclass(frozen=True)
class BuildStatus:
    """What a dataset's manifest, lock and record say of its build.

    Attributes:
        builder: the process that builds it now; null where none does.
        running: units at work, as far as the record tells.
        failed: one line per unit that failed in the latest build, the latest 100.
        num_failed: units that failed in the latest build.
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
    num_failed: int
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
    history = _latest_build(folder)
    tasks, parts_done, parts_total = _counts(manifest)
    last = history.last
    if builder and last and last["parts_total"] == parts_total:
        parts_done = max(parts_done, last["parts_done"])  # the manifest may be behind a running build
    rate = history.steps_per_second if builder else None
    return BuildStatus(
        dataset=str(folder),
        environment=manifest.name,
        complete=manifest.complete,
        tasks=tasks,
        parts_done=parts_done,
        parts_total=parts_total,
        builder=builder,
        running=tuple(history.running) if builder else (),
        failed=tuple(history.failed),
        num_failed=history.num_failed,
        steps_per_second=rate,
        seconds_left=(last["steps_total"] - last["steps_done"]) / rate if last and rate else None,
        updated=last["time"] if last else None,
    )


def _counts(manifest: Manifest) -> tuple[int, int, int]:
    """Numbers of the tasks, the published parts and the wanted parts."""
    return manifest.num_tasks, manifest.totals.parts, manifest.num_expected


def _latest_build(folder: Path) -> History:
    """What the record tells of the latest build; lines that are no events are passed over."""
    history = History()
    for line in _lines(folder):
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if _is_event(event):
            history.add(event)
    return history


def _lines(folder: Path) -> list[bytes]:
    """The lines of the record; of the earlier file only while a new one is being made."""
    for path in (folder / EVENTS, folder / EARLIER_EVENTS):
        try:
            return read_plain_file(path, limit=EVENTS_BYTES).splitlines()
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            break
    return []


def _is_event(event: object) -> bool:
    """True if a value is an event with texts that are str and bounded numbers; the file may be damaged."""
    if not isinstance(event, dict):
        return False
    if event.get("kind") == "rotated":
        event = dict(event)
        if not is_summary(event.pop("summary", None)):
            return False
    if set(event) != FIELDS:
        return False
    texts = (event["kind"], event["message"], event["unit"] or "")
    return all(isinstance(text, str) for text in texts) and all(is_number(event[name]) for name in NUMBERS)
