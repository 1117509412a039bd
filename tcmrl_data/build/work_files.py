"""What a build keeps in a dataset's folder beside the data: locks, staging, checkpoints, the event log."""

import stat
from pathlib import Path

from tcmrl_data.build.events import EARLIER_EVENTS, EVENTS
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
