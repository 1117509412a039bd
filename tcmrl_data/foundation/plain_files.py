"""Reading a stranger's files: plain ones only, never through a link, never more than was agreed."""

import os
import stat
from pathlib import Path

KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFBLK: "a block device",
    stat.S_IFCHR: "a character device",
    stat.S_IFDIR: "a folder",
}


def file_problem(status: os.stat_result) -> str | None:
    """Why a file of this `lstat` is not read, in words; None for a plain file.

    A file with several names (hard links) is refused too: a published file never changes, and another
    name, outside the dataset, can change it. Copying the dataset gives every file one name.
    """
    if not stat.S_ISREG(status.st_mode):
        return f"is {KINDS.get(stat.S_IFMT(status.st_mode), 'something odd')}, not a plain file"
    if status.st_nlink > 1:
        return f"has {status.st_nlink} names (hard links); copy the dataset and use the copy"
    return None


def read_plain_file(file: Path, *, limit: int) -> bytes:
    """The content of a plain file.

    Never blocks on a FIFO, never follows a link in the last place of the path (`folder_problem` looks at
    the places above), never allocates more than the file's size or the limit.

    Args:
        file: what to read.
        limit: most bytes allowed.

    Raises:
        ValueError: no plain file, or larger than the limit; says why, without the file's name.
        OSError: the file is missing or cannot be read.
    """
    _require_plain(os.lstat(file), limit)
    descriptor = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as opened:
        status = os.fstat(descriptor)
        _require_plain(status, limit)
        return opened.read(status.st_size)


def folder_problem(root: Path, folder: str) -> tuple[str, str] | None:
    """The first place on the way from a root to a folder below it that is no true folder, and why.

    Args:
        root: trusted; may itself be reached through a link.
        folder: relative path below it.
    """
    path = ""
    for name in Path(folder).parts:
        path = os.path.join(path, name)  # plain text: this runs for every file of a dataset
        try:
            mode = os.lstat(os.path.join(root, path)).st_mode
        except OSError as error:
            return path, f"cannot be read ({error.strerror})"
        if not stat.S_ISDIR(mode):
            kind = KINDS.get(stat.S_IFMT(mode), "a file")
            return path, f"is {kind}, not a folder"
    return None


def printable(text: str) -> str:
    r"""Text as a terminal may see it: whatever is not printable as a backslash escape, such as `\x1b`."""
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode("ascii") for each in text
    )


def one_line(error: Exception) -> str:
    """An exception's message as one short printable line."""
    text = (error.strerror or "") if isinstance(error, OSError) else ""
    return printable(" ".join((text or str(error)).split())[:200])


def words_after(error: Exception, file: Path) -> str:
    """What an error says of a file, without the file's name that it starts with."""
    return str(error).removeprefix(str(file)).lstrip(": ")


def _require_plain(status: os.stat_result, limit: int) -> None:
    problem = file_problem(status)
    if problem:
        raise ValueError(problem)
    if status.st_size > limit:
        raise ValueError(f"has {status.st_size} bytes, more than the {limit} allowed here")
