"""What a build keeps in a dataset's folder beside the data: locks, staging, checkpoints, the event log."""

import contextlib
import os
import re
import stat
from collections.abc import Collection, Sequence
from pathlib import Path

from tcmrl_data.building.events import EARLIER_EVENTS, EVENTS
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.plain_files import file_problem
from tcmrl_data.store.manifest import MANIFEST_COPY
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, TASKS

WORK_FOLDERS = {STAGING, CHECKPOINTS}
ASSEMBLY = ".assembly.json"
"""What is being put together in a folder that is no dataset yet, see `operations/assembly.py`."""

WORK_FILES = {LOCK, EVENTS, EARLIER_EVENTS, ASSEMBLY, MANIFEST_COPY}
"""A verification looks at their kind only, never into them."""

TABLES = {TASKS, PARTS_TABLE}

CARD = "README.md"
CROISSANT = "croissant.json"
CROISSANT_PARTS = "croissant-parts.jsonl"
CROISSANT_TASKS = "croissant-tasks.jsonl"
CROISSANT_FILES = {CROISSANT, CROISSANT_PARTS, CROISSANT_TASKS}
DESCRIPTIONS = {CARD} | CROISSANT_FILES
"""Files that may lie beside the data and say nothing that the data do not say."""


def check_work_files(folder: Path, *, but: Collection[str] = ()) -> None:
    """Refuses a dataset whose work files are none, or whose work folders would lead writing out of it.

    Files that are links are replaced when they are written, and may be any links; `parts` may be a link to a
    folder on another disk.

    Args:
        folder: the dataset.
        but: files that may be anything, since they will be replaced and not written into.

    Raises:
        BuildError: names the file.
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


_CHECKPOINT_NAME = re.compile(r"tasks?_([0-9]{5,10})(?:_([0-9]{5,10}))?")


def checkpoint_name(tasks: Sequence[Task]) -> str:
    """Name of the folder of a unit's checkpoints: its first and its last task, in ascending order."""
    first, last = tasks[0].index, tasks[-1].index
    return f"task_{first:05d}" if first == last else f"tasks_{first:05d}_{last:05d}"


def checkpoint_tasks(name: str) -> range | None:
    """The indices from the first to the last task of a checkpoint folder; None if it is none.

    The tasks between the two may be tasks of the unit or not built at all.
    """
    match = _CHECKPOINT_NAME.fullmatch(name)
    return range(int(match[1]), int(match[2] or match[1]) + 1) if match else None
