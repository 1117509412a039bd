"""One file with many members: a stored ZIP of exactly one form, written and read by this module alone.

Any ZIP reader opens it. This one accepts nothing but what `pack_archive` writes: members behind one another
from the first byte on, then the directory, then the end record. The reader rebuilds every header from name,
size and checksum and compares, so that no byte of the file is without a meaning.
"""

import hashlib
import re
import struct
from collections.abc import Mapping
from os import fstat, pread
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self
from zlib import crc32

from tcmrl_data.foundation.errors import StoreError, UnreadableError
from tcmrl_data.foundation.plain_files import one_line, open_plain_file, printable

LARGEST_ARCHIVE = 2**31
"""Bytes of an archive; with `MOST_MEMBERS` below what would need the ZIP64 extension."""

MOST_MEMBERS = 2**15
LONGEST_NAME = 128

REPAIR = "; run `tcmrl-data repair`"

_LOCAL = struct.Struct("<4s5H3L2H")
_CENTRAL = struct.Struct("<4s6H3L5H2L")
_END = struct.Struct("<4s4H2LH")
_VERSION = 20
_MADE_BY = 3 << 8 | _VERSION  # Unix
_DATE = 1 << 5 | 1  # 1980-01-01, at midnight
_MODE = 0o100644 << 16  # a regular file
_NAME = re.compile(rb"[a-z0-9_][a-z0-9_.]*(?:/[a-z0-9_][a-z0-9_.]*)*")

_TAIL_BYTES = 2**14
"""Read first: end record and directory of up to about 200 members."""

_HASHED_BYTES = 2**22
"""Read at once to be hashed."""


class _Member(NamedTuple):
    """A member's header, the header's offset, and the length of the content behind it."""

    header: bytes
    offset: int
    size: int
    checksum: int


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
    headers = _LOCAL.size + _CENTRAL.size
    size = _END.size + sum(headers + 2 * len(name) + len(content) for name, content in files.items())
    if size > LARGEST_ARCHIVE:
        raise StoreError(f"an archive has at most {LARGEST_ARCHIVE} bytes, got {size}; make smaller parts")
    members: list[bytes] = []
    directory: list[bytes] = []
    offset = 0
    for name, content in files.items():
        encoded = name.encode("ascii", "replace")
        if not _allowed(encoded):
            raise StoreError(
                f"a member's name is a relative path of a-z, 0-9, _ and . with at most {LONGEST_NAME} "
                f"characters, got {printable(name)[:200]!r}; rename it"
            )
        checksum = crc32(content)
        header = _local_header(encoded, len(content), checksum)
        members += (header, content)
        directory.append(_central_header(encoded, len(content), checksum, offset))
        offset += len(header) + len(content)
    end = _end_record(len(directory), sum(map(len, directory)), offset)
    return b"".join((*members, *directory, end))


class Archive:
    """An opened archive, whose directory was checked; contents are checked as they are read.

    Threads may read side by side.

    Attributes:
        path: the file.
        size: its bytes.
        sizes: name to bytes of every member, in the order of the file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "part.zip"
        >>> _ = path.write_bytes(pack_archive({"part.json": b"{}"}))
        >>> with Archive(path) as archive:
        ...     archive.names, archive.read("part.json")
        (('part.json',), b'{}')
    """

    def __init__(self, path: Path) -> None:
        """Opens an archive.

        Raises:
            StoreError: the file is missing, no plain file, or not of the one form.
        """
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
        self.sizes: Mapping[str, int] = {name: member.size for name, member in self._members.items()}

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
        """The content of a member, read at once and checked against header and checksum.

        Args:
            name: the member.
            limit: maximum size in bytes; None for what the archive holds, at most `LARGEST_ARCHIVE`.

        Raises:
            StoreError: no such member, larger than the limit, or damaged.
        """
        content = self.read_unchecked(name, limit=limit)
        if crc32(content) != self._members[name].checksum:
            raise StoreError(f"{self.place(name)} is damaged{REPAIR}")
        return content

    def read_unchecked(self, name: str, *, limit: int | None = None) -> bytes:
        """The content of a member without a look at its checksum, for content that has one of its own.

        Arguments and errors as of `read`.
        """
        member = self._members.get(name)
        if member is None:
            raise StoreError(f"{self.place(name)} is missing{REPAIR}")
        if limit is not None and member.size > limit:
            raise StoreError(
                f"{self.place(name)} has {member.size} bytes, more than the {limit} allowed here{REPAIR}"
            )
        start = member.offset + len(member.header)
        content = self._read_range(start, member.size)
        if self._read_range(member.offset, len(member.header)) != member.header or len(content) < member.size:
            raise StoreError(f"{self.place(name)} is damaged{REPAIR}")
        return content

    def content(self) -> bytes:
        """The whole file.

        Raises:
            StoreError: it cannot be read.
        """
        return self._read_range(0, self.size)

    def sha256(self) -> str:
        """The sha256 of the whole file, in hexadecimal; takes little memory.

        Raises:
            StoreError: it cannot be read.
        """
        digest = hashlib.sha256()
        for offset in range(0, self.size, _HASHED_BYTES):
            digest.update(self._read_range(offset, min(_HASHED_BYTES, self.size - offset)))
        return digest.hexdigest()

    def _read_directory(self) -> dict[str, _Member]:
        """All members by name, from the directory at the end of the file.

        Raises:
            StoreError: directory and end record are not exactly what `pack_archive` writes.
        """
        tail = self._read_range(max(0, self.size - _TAIL_BYTES), min(self.size, _TAIL_BYTES))
        end = tail[-_END.size :]
        if len(end) < _END.size:
            raise self._refusal("is too short for an archive")
        count, length, start = _END.unpack(end)[4:7]
        if end != _end_record(count, length, start):
            raise self._refusal("does not end as an archive does")
        if start + length + _END.size != self.size:
            raise self._refusal("has bytes that belong to no member")
        if count > MOST_MEMBERS or length > count * (_CENTRAL.size + LONGEST_NAME):
            raise self._refusal(f"has a directory of {length} bytes for {count} members")
        if length + _END.size <= len(tail):
            directory = tail[len(tail) - _END.size - length : -_END.size]
        else:
            directory = self._read_range(start, length)
        return self._parse(directory, count, start)

    def _parse(self, directory: bytes, count: int, start: int) -> dict[str, _Member]:
        """All members by name, if they fill the file up to the directory's start.

        Raises:
            StoreError: an entry is not what `pack_archive` writes for a member at this place.
        """
        members: dict[str, _Member] = {}
        position = offset = 0
        for number in range(1, count + 1):
            if len(directory) < position + _CENTRAL.size:
                raise self._refusal(f"has a directory that ends before entry {number} of {count}")
            fields = _CENTRAL.unpack_from(directory, position)
            checksum, size, name_length = fields[7], fields[9], fields[10]
            name = directory[position + _CENTRAL.size : position + _CENTRAL.size + name_length]
            expected = _central_header(name, size, checksum, offset)
            if not _allowed(name) or not directory.startswith(expected, position):
                raise self._refusal(f"has a directory whose entry {number} is of no allowed form")
            member = _Member(_local_header(name, size, checksum), offset, size, checksum)
            if members.setdefault(name.decode("ascii"), member) is not member:
                raise self._refusal(f"has two members {name.decode('ascii')}")
            position += len(expected)
            offset += len(member.header) + size
            if offset > start:
                raise self._refusal(f"has no room for the content of {name.decode('ascii')}")
        if position != len(directory) or offset != start:
            raise self._refusal("has bytes that belong to no member")
        return members

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

    def _refusal(self, problem: str) -> StoreError:
        return StoreError(f"{self.path} {problem}{REPAIR}")


def _allowed(name: bytes) -> bool:
    return len(name) <= LONGEST_NAME and _NAME.fullmatch(name) is not None


def _local_header(name: bytes, size: int, checksum: int) -> bytes:
    """What stands before a member's content."""
    return _LOCAL.pack(b"PK\3\4", _VERSION, 0, 0, 0, _DATE, checksum, size, size, len(name), 0) + name


def _central_header(name: bytes, size: int, checksum: int, offset: int) -> bytes:
    """A member's entry in the directory."""
    return (
        _CENTRAL.pack(
            *(b"PK\1\2", _MADE_BY, _VERSION, 0, 0, 0, _DATE, checksum, size, size),
            *(len(name), 0, 0, 0, 0, _MODE, offset),
        )
        + name
    )


def _end_record(count: int, length: int, start: int) -> bytes:
    """The end of an archive: members, and where its directory lies."""
    return _END.pack(b"PK\5\6", 0, 0, count, count, length, start, 0)
