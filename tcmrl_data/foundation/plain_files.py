"""Reading untrusted files: regular files only, without following links, up to a size limit."""

import os
import stat
from pathlib import Path
from typing import BinaryIO

KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFBLK: "a block device",
    stat.S_IFCHR: "a character device",
    stat.S_IFDIR: "a folder",
}


def file_problem(status: os.stat_result) -> str | None:
    """Why a file with this `lstat` result must not be read; None for a regular file with one name.

    A file with hard links is refused, because a program can change it through a name outside the dataset.
    Copying the dataset gives every file one name.
    """
    if not stat.S_ISREG(status.st_mode):
        return f"is {KINDS.get(stat.S_IFMT(status.st_mode), 'something odd')}, not a plain file"
    if status.st_nlink > 1:
        return f"has {status.st_nlink} names (hard links); copy the dataset and use the copy"
    return None


def read_plain_file(file: Path, *, limit: int) -> bytes:
    """Reads a regular file.

    Does not block on a FIFO, does not follow a link in the path's last component (`folder_problem` checks the
    components before it), and allocates at most `limit` bytes.

    Args:
        file: the file.
        limit: maximum size in bytes.

    Raises:
        ValueError: not a regular file, or larger than the limit; the message does not name the file.
        OSError: the file is missing or cannot be read.
    """
    with open_plain_file(file, limit=limit) as opened:
        return opened.read(min(limit, os.fstat(opened.fileno()).st_size))


def open_plain_file(file: Path, *, limit: int) -> BinaryIO:
    """Opens a regular file for reading, under the conditions of `read_plain_file`.

    Raises:
        ValueError: not a regular file, or larger than the limit; the message does not name the file.
        OSError: the file is missing or cannot be opened.
    """
    _require_plain(os.lstat(file), limit)
    descriptor = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _require_plain(os.fstat(descriptor), limit)
    except ValueError:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def folder_problem(root: Path, folder: str) -> tuple[str, str] | None:
    """Finds the first component of a relative path that is not a real folder.

    Args:
        root: trusted folder; its own path may contain links.
        folder: path relative to `root`.

    Returns:
        The component's path relative to `root` and the reason, or None if all components are folders.
    """
    path = ""
    for name in Path(folder).parts:
        path = os.path.join(path, name)  # faster than Path; this runs for every file of a dataset
        try:
            mode = os.lstat(os.path.join(root, path)).st_mode
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


def _require_plain(status: os.stat_result, limit: int) -> None:
    problem = file_problem(status)
    if problem:
        raise ValueError(problem)
    if status.st_size > limit:
        raise ValueError(f"has {status.st_size} bytes, more than the {limit} allowed here")
