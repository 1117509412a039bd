"""One file with many members: a stored ZIP, written and read through the standard library's `zipfile`.

Any ZIP reader opens it. What is written is a function of names and contents alone. Reading takes any stored
ZIP; `Archive.check_form` also refuses bytes that `pack_archive` does not write, where no digest tells them.
"""

import hashlib
import io
import re
import struct
import zipfile
from collections.abc import Mapping
from os import fstat, pread
from pathlib import Path
from types import TracebackType
from typing import Self
from zlib import crc32

from tcmrl_data.foundation.errors import StoreError, UnreadableError
from tcmrl_data.foundation.files import one_line, open_plain_file, printable

LARGEST_ARCHIVE = 2**31
"""Bytes of an archive; with `MOST_MEMBERS` below what would need the ZIP64 extension."""

MOST_MEMBERS = 2**15
LONGEST_NAME = 128

REPAIR = "; run `tcmrl-data verify --repair`"

_LOCAL, _CENTRAL, _END = 30, 46, 22
"""Bytes of a member's header and of its entry in the directory, but for its name, and of the end record."""

_NAME = re.compile(r"[a-z0-9_][a-z0-9_.]*(?:/[a-z0-9_][a-z0-9_.]*)*")
_HASHED_BYTES = 2**22
"""Read at once to be hashed."""


def pack_archive(files: Mapping[str, bytes]) -> bytes:
    """The bytes of an archive; equal files in equal order give equal bytes.

    Args:
        files: name to content, in the order of the archive. Names are relative paths of lower-case letters,
            digits, `_` and `.`; no component starts with a dot.

    Raises:
        StoreError: `Archive` would refuse the result: a name, the number of members, or the size.
    """
    if len(files) > MOST_MEMBERS:
        raise StoreError(f"an archive has at most {MOST_MEMBERS} members, got {len(files)}")
    size = _END + sum(_LOCAL + _CENTRAL + 2 * len(name) + len(content) for name, content in files.items())
    if size > LARGEST_ARCHIVE:
        raise StoreError(f"an archive has at most {LARGEST_ARCHIVE} bytes, got {size}; make smaller parts")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            if not _allowed(name):
                raise StoreError(
                    f"a member's name is a relative path of a-z, 0-9, _ and . with at most {LONGEST_NAME} "
                    f"characters, got {printable(name)[:200]!r}; rename it"
                )
            member = zipfile.ZipInfo(name)  # of 1980-01-01
            member.create_system = 3  # Unix, on every system
            member.external_attr = 0o100644 << 16  # a regular file
            archive.writestr(member, content)
    return buffer.getvalue()


class Archive:
    """An opened archive; contents are checked as they are read. Threads may read side by side.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "part.zip"
        >>> _ = path.write_bytes(pack_archive({"part.json": b"{}"}))
        >>> with Archive(path) as archive:
        ...     archive.names, archive.read("part.json")
        (('part.json',), b'{}')
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = open_plain_file(path, limit=LARGEST_ARCHIVE)
        except FileNotFoundError:
            raise StoreError(f"{path} is missing{REPAIR}") from None
        except OSError as error:
            raise UnreadableError(f"{path} cannot be read ({one_line(error)})") from None
        except ValueError as error:
            raise StoreError(f"{path} {error}{REPAIR}") from None
        try:
            self.size = fstat(self._file.fileno()).st_size
            self._members = self._read_directory()
        except BaseException:
            self.close()
            raise

    @property
    def names(self) -> tuple[str, ...]:
        """The members' names in the order of the file."""
        return tuple(self._members)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file; a closed archive cannot be read."""
        self._file.close()

    def place(self, name: str) -> str:
        """A member as messages name it."""
        return f"{self.path}: {name}"

    def read(self, name: str, *, limit: int | None = None) -> bytes:
        """The content of a member, checked against its checksum.

        Args:
            limit: maximum size in bytes; None for what the archive holds, at most `LARGEST_ARCHIVE`.
        """
        content = self.read_unchecked(name, limit=limit)
        if crc32(content) != self._members[name].CRC:
            raise StoreError(f"{self.place(name)} is damaged{REPAIR}")
        return content

    def read_unchecked(self, name: str, *, limit: int | None = None) -> bytes:
        """The content of a member without a look at its checksum, for content that has one of its own.

        Arguments and errors as of `read`.
        """
        member = self._members.get(name)
        if member is None:
            raise StoreError(f"{self.place(name)} is missing{REPAIR}")
        size = member.file_size
        if limit is not None and size > limit:
            raise StoreError(
                f"{self.place(name)} has {size} bytes, more than the {limit} allowed here{REPAIR}"
            )
        start = _LOCAL + len(name)
        data = self._read_range(member.header_offset, start + size)
        header = (data[:4], data[26:_LOCAL], data[_LOCAL:start])
        if header != (b"PK\3\4", struct.pack("<2H", len(name), 0), name.encode()) or len(data) < start + size:
            raise StoreError(f"{self.place(name)} is damaged{REPAIR}")
        return data[start:]

    def check_form(self) -> None:
        """Reads everything and compares it with what `pack_archive` writes.

        Raises:
            StoreError: a member is damaged, or a byte belongs to no member.
        """
        if pack_archive({name: self.read(name) for name in self.names}) != self.content():
            raise StoreError(f"{self.path} is not written as archives are here{REPAIR}")

    def content(self) -> bytes:
        """The whole file."""
        return self._read_range(0, self.size)

    def sha256(self) -> str:
        """The sha256 of the whole file, in hexadecimal; takes little memory."""
        digest = hashlib.sha256()
        for offset in range(0, self.size, _HASHED_BYTES):
            digest.update(self._read_range(offset, min(_HASHED_BYTES, self.size - offset)))
        return digest.hexdigest()

    def _read_directory(self) -> dict[str, zipfile.ZipInfo]:
        self._read_range(max(0, self.size - _END), _END)  # what the system refuses is no damage
        try:
            with zipfile.ZipFile(self._file) as archive:
                members = archive.infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError, OverflowError, struct.error) as error:
            raise StoreError(f"{self.path} is no archive ({one_line(error)}){REPAIR}") from None
        if len(members) > MOST_MEMBERS:
            raise StoreError(
                f"{self.path} has {len(members)} members, at most {MOST_MEMBERS} are allowed{REPAIR}"
            )
        found: dict[str, zipfile.ZipInfo] = {}
        for member in members:
            if (
                not _allowed(member.filename)
                or member.filename in found
                or (member.compress_type, member.flag_bits) != (zipfile.ZIP_STORED, 0)
                or member.compress_size != member.file_size
                or not 0 <= member.header_offset <= self.size - member.file_size
            ):
                raise StoreError(f"{self.path} has a member of no allowed form{REPAIR}")
            found[member.filename] = member
        return found

    def _read_range(self, offset: int, size: int) -> bytes:
        """Bytes of the file; fewer where it has become shorter."""
        descriptor = self._file.fileno()
        try:
            data = pread(descriptor, size, offset)
            while len(data) < size:  # the system may give less at once, mostly beyond 2 GiB
                more = pread(descriptor, size - len(data), offset + len(data))
                if not more:
                    break
                data += more
        except OSError as error:
            raise UnreadableError(f"{self.path} cannot be read ({one_line(error)})") from None
        return data


def _allowed(name: str) -> bool:
    return len(name) <= LONGEST_NAME and _NAME.fullmatch(name) is not None
