"""What a build keeps in a dataset's folder beside the data: locks, staging, checkpoints, and its status.

The status is `status.json`: how far the latest build is, what runs and what failed. The build replaces it at
most once a second, so that anyone may read it at any time.
"""

import contextlib
import os
import re
import stat
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING, lock_holder, make_folders, place_file
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.files import file_problem, read_plain_file
from tcmrl_data.foundation.records import Record, as_model, canonical_json, parse_json
from tcmrl_data.store.manifest import MANIFEST_COPY, dataset_folder, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, TASKS

WORK_FOLDERS = {STAGING, CHECKPOINTS}
ASSEMBLY = ".assembly.json"
"""What is being put together in a folder that is no dataset yet, see `operations/assembly.py`."""

STATUS = "status.json"
WORK_FILES = {LOCK, STATUS, ASSEMBLY, MANIFEST_COPY, "events.jsonl", "events.1.jsonl"}
"""A verification looks at their kind only, never into them. The last two were written by earlier versions."""

TABLES = {TASKS, PARTS_TABLE}

CROISSANT = "croissant.json"
CROISSANT_PARTS = "croissant-parts.jsonl"
CROISSANT_TASKS = "croissant-tasks.jsonl"
CROISSANT_FILES = {CROISSANT, CROISSANT_PARTS, CROISSANT_TASKS}
DESCRIPTIONS = {"README.md"} | CROISSANT_FILES
"""Files that may lie beside the data and say nothing that the data do not say."""

VIEWER = "viewer"
"""Folder of the same kind, which `describe.viewer` writes."""


def is_viewer_file(file: str) -> bool:
    """Whether the path of a file within a dataset is one of the viewer's."""
    return re.fullmatch(rf"{VIEWER}/(train|test)/\w+\.parquet", file) is not None


def check_work_files(folder: Path, *, but: Collection[str] = ()) -> None:
    """Refuses a dataset whose work files are none, or whose work folders would lead writing out of it.

    Files that are links are replaced when they are written, and may be any links; `parts` may be a link to a
    folder on another disk.

    Args:
        but: files that may be anything, since they will be replaced and not written into.
    """
    for name in sorted((WORK_FILES | WORK_FOLDERS | TABLES | {PARTS}) - {*but}):
        try:
            status = (folder / name).stat(follow_symlinks=name not in WORK_FOLDERS)
        except OSError:  # it is not there, or a link to nothing
            continue
        is_folder = stat.S_ISDIR(status.st_mode)
        is_file = name in WORK_FILES | TABLES
        if file_problem(status) if is_file else not is_folder:
            raise BuildError(f"{folder / name} is not the plain file or folder that a build makes; delete it")
    for name in sorted(WORK_FOLDERS):
        _check_work_folder(folder / name)


def _check_work_folder(folder: Path) -> None:
    """Refuses links to folders, pipes and devices at any depth; others may change the folder meanwhile."""
    waiting = [folder]
    while waiting:
        with contextlib.suppress(FileNotFoundError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(Path(entry.path))
                elif not entry.is_file() and os.path.exists(entry.path):
                    raise BuildError(f"{entry.path} is no plain file or folder; delete it")


WRITE_SECONDS = 1.0
"""The status is written at most this often, but at once where a build starts, warns, fails or ends."""

WINDOW_SECONDS = 60
"""Training speed is measured over this time."""

MAX_MESSAGES = 100
"""Of more failures or warnings the latest are kept."""

MESSAGE_CHARACTERS = 1_000
"""A longer message is cut in the status."""

EventKind = Literal["start", "steps", "part", "warning", "unit_done", "unit_failed", "end"]


@dataclass(frozen=True)
class BuildEvent:
    """How far a build is.

    Attributes:
        steps_done: environment steps of behavior training, resumed ones included.
    """

    kind: EventKind
    unit: str | None
    parts_done: int
    parts_total: int
    steps_done: int
    steps_total: int
    message: str


class _Status(Record):
    """The content of `status.json`.

    Attributes:
        time: Unix time of the latest event.
        running: ids of the units at work, in the order of their first events.
        steps_per_second: environment steps of behavior training, over the latest minute; None if none.
    """

    time: float
    parts_done: int
    parts_total: int
    steps_done: int
    steps_total: int
    running: tuple[str, ...]
    failed: tuple[str, ...]
    num_failed: int
    warnings: tuple[str, ...]
    steps_per_second: float | None


class StatusFile:
    """Keeps `status.json` of a build up to date and passes its events on.

    The status is no part of the data and is not forced to disk.
    """

    def __init__(self, dataset: Path, progress: Callable[[BuildEvent], None] | None = None) -> None:
        self._progress, self._dataset = progress, dataset
        self._written = float("-inf")
        self._running: dict[str, None] = {}
        self._failed: deque[str] = deque(maxlen=MAX_MESSAGES)
        self._warnings: deque[str] = deque(maxlen=MAX_MESSAGES)
        self._num_failed = 0
        self._paces: dict[int, tuple[float, int]] = {}  # second: time and steps of its first event

    def write(self, event: BuildEvent) -> None:
        """Takes in an event, writes the status if it is time to, and reports the event."""
        now, message = time.time(), event.message[:MESSAGE_CHARACTERS]
        if event.kind in ("unit_done", "unit_failed"):
            self._running.pop(event.unit or "", None)
        elif event.unit:
            self._running[event.unit] = None
        if event.kind == "unit_failed":
            self._failed.append(message)
            self._num_failed += 1
        elif event.kind == "warning":
            self._warnings.append(message)
        rate = self._rate(now, event.steps_done)
        if event.kind not in ("steps", "part", "unit_done") or now - self._written >= WRITE_SECONDS:
            status = _Status(
                time=round(now, 3),
                parts_done=event.parts_done,
                parts_total=event.parts_total,
                steps_done=event.steps_done,
                steps_total=event.steps_total,
                running=tuple(self._running),
                failed=tuple(self._failed),
                num_failed=self._num_failed,
                warnings=tuple(self._warnings),
                steps_per_second=rate,
            )
            staging = self._dataset / STAGING
            make_folders(staging)
            data = canonical_json(status.model_dump(mode="json"))
            place_file(self._dataset / STATUS, data, staging=staging)
            self._written = now
        if self._progress is not None:
            self._progress(event)

    def _rate(self, now: float, steps: int) -> float | None:
        self._paces.setdefault(int(now), (now, steps))
        self._paces = {
            second: pace for second, pace in self._paces.items() if 0 <= now - second <= WINDOW_SECONDS
        }
        then, before = self._paces[min(self._paces)]
        return (steps - before) / (now - then) if now > then and steps > before else None


@dataclass(frozen=True)
class BuildStatus:
    """What a dataset's manifest, lock and `status.json` say of its build.

    Attributes:
        builder: the process that builds it now; null where none does.
        failed: one line per unit that failed in the latest build, the latest 100.
        steps_per_second: environment steps of behavior training, over the latest minute.
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
    manifest, builder = read_manifest(folder), lock_holder(folder / LOCK)
    latest = _read_status(folder)
    parts_done, parts_total = manifest.totals.parts, manifest.num_expected
    if builder and latest and latest.parts_total == parts_total:
        parts_done = max(parts_done, latest.parts_done)  # the manifest may be behind a running build
    rate = latest.steps_per_second if builder and latest else None
    return BuildStatus(
        dataset=str(folder),
        environment=manifest.name,
        complete=manifest.complete,
        tasks=manifest.num_tasks,
        parts_done=parts_done,
        parts_total=parts_total,
        builder=builder,
        running=latest.running if builder and latest else (),
        failed=latest.failed if latest else (),
        num_failed=latest.num_failed if latest else 0,
        steps_per_second=rate,
        seconds_left=(latest.steps_total - latest.steps_done) / rate if latest and rate else None,
        updated=latest.time if latest else None,
    )


def _read_status(folder: Path) -> _Status | None:
    """What the latest build wrote; None where nothing can be read, as in a stranger's folder."""
    try:
        return as_model(_Status, parse_json(read_plain_file(folder / STATUS, limit=2**24)))
    except (OSError, ValueError, ValidationError):
        return None
