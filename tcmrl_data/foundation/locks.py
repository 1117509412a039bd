"""Locks on open files that hold between machines which share a folder over NFS, and waiting for their files.

On Linux a lock is an open file description lock of `fcntl`, for three reasons:

- Anyone may ask whether it is held without taking it, with a read-only descriptor. A question that takes a
  lock, as `flock` needs, makes a writer that starts at that moment fail.
- It belongs to the open file, not to the process as classic POSIX locks do: two writers in one process
  exclude each other, and closing another descriptor of the same file does not release it.
- NFS passes it to the server, and grants it to a file that is open for writing; a shared one, for reading.

The package `filelock` takes `flock`, which nobody can ask for without taking it, or makes a file, which a
killed holder leaves behind. The kernel releases these locks when their holder ends, however it ends.

Other systems have no such locks; there `flock` is used, and a writer waits while others ask.
"""

import contextlib
import errno
import fcntl
import os
import struct
import time
from pathlib import Path
from typing import IO, Any

HAS_OPEN_FILE_LOCKS = hasattr(fcntl, "F_OFD_SETLK")

PROBE_ATTEMPTS = 100
PROBE_SECONDS = 0.02
"""With `flock`, a writer retries this often, at this interval, while others ask for its lock."""

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
"""What file systems without locks answer."""

_WHOLE_FILE = (0, 0, 0, 0)  # l_whence, l_start, l_len, and l_pid, which these locks leave at 0
_FLOCK = "hhqqi4x"  # struct flock of 64-bit Linux


def try_exclusive_lock(file: IO[Any]) -> bool:
    """Takes the exclusive lock on a file; closing the file releases it.

    Args:
        file: open for writing.

    Returns:
        False, at once, if another open file holds the lock.

    Raises:
        OSError: the file system has no locks.
    """
    if not HAS_OPEN_FILE_LOCKS:
        return _try_flock_while_asked(file)
    try:
        fcntl.fcntl(file, fcntl.F_OFD_SETLK, struct.pack(_FLOCK, fcntl.F_WRLCK, *_WHOLE_FILE))
    except (BlockingIOError, PermissionError):  # POSIX allows EAGAIN and EACCES
        return False
    return True


def take_shared_lock(file: IO[Any]) -> None:
    """Takes the shared lock on a file; waits while another open file holds the exclusive lock.

    Args:
        file: open for reading; closing it releases the lock.

    Raises:
        OSError: the file system has no locks.
    """
    if HAS_OPEN_FILE_LOCKS:
        fcntl.fcntl(file, fcntl.F_OFD_SETLKW, struct.pack(_FLOCK, fcntl.F_RDLCK, *_WHOLE_FILE))
    else:
        fcntl.flock(file, fcntl.LOCK_SH)


def is_locked(file: IO[Any]) -> bool:
    """True if another open file holds the exclusive lock; on Linux also for a shared one.

    On Linux, asking never disturbs a writer.

    Args:
        file: may be open for reading only.

    Returns:
        False where the file system has no locks, since nobody can hold one there.
    """
    try:
        if not HAS_OPEN_FILE_LOCKS:
            return not _try_flock(file, fcntl.LOCK_SH)
        asked = struct.pack(_FLOCK, fcntl.F_WRLCK, *_WHOLE_FILE)
        found = struct.unpack(_FLOCK, fcntl.fcntl(file, fcntl.F_OFD_GETLK, asked))
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return False
    return bool(found[0] != fcntl.F_UNLCK)


def _try_flock_while_asked(file: IO[Any]) -> bool:
    """Takes the lock; a shared lock belongs to somebody who asks, so it is waited for."""
    for _ in range(PROBE_ATTEMPTS):
        if _try_flock(file, fcntl.LOCK_EX):
            return True
        if not _try_flock(file, fcntl.LOCK_SH):
            return False
        fcntl.flock(file, fcntl.LOCK_UN)
        time.sleep(PROBE_SECONDS)
    return False


def _try_flock(file: IO[Any], kind: int) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


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
