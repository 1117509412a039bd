"""Reading files of strangers: regular files only, up to a size limit.

Links and hard links to regular files are how people keep copies (`cp -al`, DVC, the Hub's cache), and are
followed. What is no regular file is refused once it is open, before a byte of it is read.
"""

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

    Args:
        root: the folder that the path begins in.
        folder: path relative to `root`.

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
