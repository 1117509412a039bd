"""Waiting for files that another machine made in a shared folder."""

import contextlib
import os
import time
from pathlib import Path

VISIBLE_SECONDS = 60.0
"""NFS may remember the content of a folder for this long (its option `acdirmax`)."""

FIRST_PAUSE, LONGEST_PAUSE = 0.05, 2.0


def wait_until_visible(path: Path, *, deadline: float = VISIBLE_SECONDS) -> bool:
    """Waits for a file or folder that another machine says it has made.

    Args:
        path: the file or folder.
        deadline: seconds to wait at most; a path that is there is never waited for.

    Returns:
        False if it is not there at the deadline.
    """
    end, pause = time.monotonic() + deadline, FIRST_PAUSE
    while not path.exists():
        left = end - time.monotonic()
        if left <= 0:
            return False
        time.sleep(min(pause, left))
        pause = min(2 * pause, LONGEST_PAUSE)
        _look_again(path.parent)
    return True


def _look_again(folder: Path) -> None:
    """Makes NFS ask the server what is in a folder, or in the next one above that is there."""
    for place in (folder, *folder.parents):
        with contextlib.suppress(OSError):
            os.listdir(place)
            return
