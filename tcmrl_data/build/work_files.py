"""What a build keeps in a dataset's folder beside the data: locks, staging, checkpoints, the event log."""

import re
import stat
from collections.abc import Sequence
from pathlib import Path

from tcmrl_data.build.events import EARLIER_EVENTS, EVENTS
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.plain_files import file_problem

WORK_FOLDERS = {STAGING, CHECKPOINTS}
WORK_FILES = {LOCK, EVENTS, EARLIER_EVENTS}
"""A verification looks at their kind only, never into them."""


def check_work_files(folder: Path) -> None:
    """Refuses a dataset whose work files or folders are links, which would lead writing out of it.

    Raises:
        BuildError: names the file.
    """
    for name in sorted(WORK_FILES | WORK_FOLDERS | {"tasks"}):
        try:
            status = (folder / name).lstat()
        except FileNotFoundError:
            continue
        is_folder = stat.S_ISDIR(status.st_mode)
        if (name in WORK_FILES and file_problem(status)) or (name not in WORK_FILES and not is_folder):
            raise BuildError(f"{folder / name} is not the plain file or folder that a build makes; delete it")


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
