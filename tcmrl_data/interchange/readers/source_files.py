"""Files that others wrote: which may be read, their digests, and how much memory their size justifies."""

import hashlib
import stat
from collections.abc import Sequence
from pathlib import Path

from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import KINDS, one_line, printable

FLOOR_BYTES = 4 * 2**20
"""What may be decoded of a file whatever its size."""

LARGEST_RATIO = 4
"""Bytes that may be decoded for each byte of a file; numbers as the field records them seldom reach two."""


def decoded_limit(file_bytes: int) -> int:
    """Bytes that may be decoded of files of this size."""
    return FLOOR_BYTES + LARGEST_RATIO * file_bytes


def require_file(path: Path) -> Path:
    """The file at a path, if it is one; a path that a user has named may lead through links.

    Raises:
        StoreError: it is missing or no regular file.
    """
    try:
        resolved = path.resolve(strict=True)
        mode = resolved.lstat().st_mode
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{path} cannot be read ({one_line(error)}); name a file that can") from None
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "something odd")
        raise StoreError(f"{path} is {kind}, not a file; name a file")
    return resolved


def require_own_file(path: Path) -> None:
    """Checks a file that a folder of a stranger holds, where a link could lead out.

    Raises:
        StoreError: it is missing, a link or no regular file.
    """
    try:
        mode = path.lstat().st_mode
    except OSError as error:
        raise StoreError(f"{_shown(path)} cannot be read ({one_line(error)})") from None
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "something odd")
        raise StoreError(f"{_shown(path)} is {kind}, not a plain file; replace it by a copy")


def path_digest(path: Path, files: Sequence[Path]) -> list[str]:
    """Name and sha256 of a path of the command line, as they stand in the origin of a run.

    A folder's is that of the names and digests of the files that are read of it, since there may be many.

    Args:
        path: the path.
        files: what is read of it: the file itself, or files in the folder.

    Raises:
        StoreError: a file cannot be read.
    """
    name = printable(path.resolve().name)
    if len(files) == 1 and files[0] == path.resolve():
        return [name, _file_digest(files[0])]
    members = [[file.relative_to(path).as_posix(), _file_digest(file)] for file in files]
    return [name, digest(members)]


def _file_digest(file: Path) -> str:
    try:
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        raise StoreError(f"{_shown(file)} cannot be read ({one_line(error)})") from None


def _shown(path: Path) -> str:
    return printable(str(path))
