"""Files that others may have made, hold or still be writing: read if regular, locked, waited for.

Links and hard links to regular files are how people keep copies (`cp -al`, DVC, the Hub's cache), and are
followed. What is no regular file is refused once it is open, before a byte of it is read.

A lock is an open file description lock of Linux. Anyone may ask for its holder without taking it (unlike
`flock`, which the package `filelock` takes), so that asking never makes a starting writer fail. It belongs to
the open file, so two writers in one process exclude each other. NFS passes it to the server. The kernel
releases it when its holder ends, however it ends.
"""

import contextlib
import errno
import fcntl
import os
import stat
import struct
import time
from pathlib import Path
from typing import IO, Any, BinaryIO

KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFBLK: "a block device",
    stat.S_IFCHR: "a character device",
    stat.S_IFDIR: "a folder",
}


def file_problem(status: os.stat_result) -> str | None:
    """Why a file with this status must not be read; None for a regular file."""
    if stat.S_ISREG(status.st_mode):
        return None
    if stat.S_ISLNK(status.st_mode):  # a link that is not followed, or could not be
        return "is a link that leads to no file"
    return f"is {KINDS.get(stat.S_IFMT(status.st_mode), 'something odd')}, not a plain file"


def status_of(entry: os.DirEntry[str]) -> os.stat_result:
    """The status of what an entry of a folder is or leads to; that of the link where it leads to nothing.

    Raises:
        FileNotFoundError: it was removed meanwhile.
    """
    try:
        return entry.stat()
    except OSError:
        return entry.stat(follow_symlinks=False)


def read_plain_file(file: Path, *, limit: int) -> bytes:
    """Reads a regular file, also through links; does not block on a FIFO.

    Raises:
        ValueError: not a regular file, or larger than the limit; the message does not name the file.
        OSError: the file is missing or cannot be read.
    """
    with open_plain_file(file, limit=limit) as opened:
        return opened.read(min(limit, os.fstat(opened.fileno()).st_size))


def open_plain_file(file: Path, *, limit: int) -> BinaryIO:
    """Opens a regular file for reading; errors as of `read_plain_file`."""
    descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    problem = file_problem(status)
    if problem is None and status.st_size > limit:
        problem = f"has {status.st_size} bytes, more than the {limit} allowed here"
    if problem is not None:
        os.close(descriptor)
        raise ValueError(problem)
    return os.fdopen(descriptor, "rb")


def folder_problem(root: Path, folder: str) -> tuple[str, str] | None:
    """Finds the first component of a relative path that is neither a folder nor leads to one.

    Returns:
        The component's path relative to `root` and the reason, or None if all components are folders.
    """
    path = ""
    for name in Path(folder).parts:
        path = os.path.join(path, name)  # faster than Path; this runs for every file of a dataset
        try:
            mode = os.stat(os.path.join(root, path)).st_mode
        except OSError as error:
            return path, f"cannot be read ({error.strerror})"
        if not stat.S_ISDIR(mode):
            kind = KINDS.get(stat.S_IFMT(mode), "a file")
            return path, f"is {kind}, not a folder"
    return None


def printable(text: str) -> str:
    r"""Text with every character that is not printable replaced by an escape such as `\x1b`."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def one_line(error: Exception) -> str:
    """An exception's message as one short printable line."""
    text = (error.strerror or "") if isinstance(error, OSError) else ""
    return printable(" ".join((text or str(error)).split())[:200])


def words_after(error: Exception, file: Path) -> str:
    """An error's message without the file name at its start."""
    return str(error).removeprefix(str(file)).lstrip(": ")


NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
"""What file systems without locks answer."""

_WHOLE_FILE = (0, 0, 0, 0)  # l_whence, l_start, l_len, and l_pid, which these locks leave at 0
_FLOCK = "hhqqi4x"  # struct flock of 64-bit Linux


def try_exclusive_lock(file: IO[Any]) -> bool:
    """Takes the exclusive lock on a file; closing the file releases it.

    Returns:
        False, at once, if another open file holds the lock.

    Raises:
        OSError: the file system has no locks.
    """
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
    fcntl.fcntl(file, fcntl.F_OFD_SETLKW, struct.pack(_FLOCK, fcntl.F_RDLCK, *_WHOLE_FILE))


def is_locked(file: IO[Any]) -> bool:
    """True if another open file holds the lock, exclusive or shared; asking never disturbs a writer.

    Returns:
        False where the file system has no locks, since nobody can hold one there.
    """
    asked = struct.pack(_FLOCK, fcntl.F_WRLCK, *_WHOLE_FILE)
    try:
        found = struct.unpack(_FLOCK, fcntl.fcntl(file, fcntl.F_OFD_GETLK, asked))
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return False
    return bool(found[0] != fcntl.F_UNLCK)


VISIBLE_SECONDS = 60.0
"""NFS may remember the content of a folder for this long (its option `acdirmax`)."""

FIRST_PAUSE, LONGEST_PAUSE = 0.05, 2.0


def wait_until_visible(path: Path, *, deadline: float = VISIBLE_SECONDS) -> bool:
    """Waits for a file or folder that another machine says it has made.

    Args:
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
