"""Tables of a dataset: files of JSON lines, of which the manifest seals a beginning.

A build appends a line per published part, which takes the same time however many there are, and seals what
stands there from time to time. Lines behind the sealed ones are its log: after a crash the next build reads
them again. Readers read the sealed lines only.
"""

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path

from tcmrl_data.foundation.disk import STAGING, disk, make_own, named_errors
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.plain_files import one_line, open_plain_file
from tcmrl_data.store.limits import LINE_BYTES, MAX_COUNT
from tcmrl_data.store.manifest import TableSeal

BLOCK_BYTES = 2**20
"""Lines are parsed in blocks of about this size, so that parsed lines take little memory."""


def read_sealed(file: Path, seal: TableSeal) -> bytes:
    """The sealed lines of a table.

    Raises:
        ManifestError: the file is missing or damaged, or is no plain file; the message names it.
    """
    data = read_lines(file, seal.bytes)
    found = hashlib.sha256(data).hexdigest()
    if len(data) != seal.bytes or found != seal.sha256 or data.count(b"\n") != seal.lines:
        raise ManifestError(
            f"{file}: its first {seal.bytes} bytes are not those that the manifest seals; "
            "run `tcmrl-data repair`"
        )
    return data


def seal_of(lines: bytes) -> TableSeal:
    """The seal of a table that consists of the given lines."""
    digest = hashlib.sha256(lines).hexdigest()
    return TableSeal(lines=lines.count(b"\n"), bytes=len(lines), sha256=digest)


def read_log(file: Path, seal: TableSeal) -> bytes:
    """The complete lines behind the sealed ones; errors as of `read_lines`."""
    return read_lines(file, MAX_COUNT)[seal.bytes :]


def blocks(data: bytes, file: Path) -> Iterator[bytes]:
    """Splits lines into JSON arrays of many lines each.

    Raises:
        ManifestError: a line is too long; the message names the file.
    """
    start = 0
    while start < len(data):
        end = data.rfind(b"\n", start, start + BLOCK_BYTES)
        lines = data[start : max(end, start)].split(b"\n")
        if end < 0 or max(map(len, lines)) > LINE_BYTES:
            raise ManifestError(f"{file}: a line has more than {LINE_BYTES} bytes")
        yield b"[" + b",".join(lines) + b"]"
        start = end + 1


def read_lines(file: Path, num_bytes: int) -> bytes:
    """The complete lines among the first bytes of a table, up to a block without a line's end.

    A file of holes thus takes no memory.

    Raises:
        ManifestError: the file is missing, or is no plain file; the message names it.
    """
    data = bytearray()
    try:
        with open_plain_file(file, limit=sys.maxsize) as opened:
            while b"\n" in (block := opened.read(min(BLOCK_BYTES, num_bytes - len(data)))):
                data += block
        return bytes(data[: data.rfind(b"\n") + 1])
    except FileNotFoundError:
        raise ManifestError(f"{file} is missing; run `tcmrl-data repair`") from None
    except (OSError, ValueError) as error:
        raise ManifestError(f"{file}: {one_line(error)}") from None


class TableWriter:
    """Appends lines to a table that the manifest then seals.

    Args:
        file: the table; created if it does not exist.
        lines: the complete lines that stand there and are kept; what follows them is cut off.
    """

    def __init__(self, file: Path, lines: bytes = b"") -> None:
        self._file = file
        self._state = (hashlib.sha256(lines), seal_of(lines))
        self._is_named = bool(lines)

    def append(self, lines: bytes) -> None:
        """Writes complete lines behind the others; not forced to disk before they are sealed.

        Raises:
            StorageError: the operating system refuses the operation; the lines do not count then.
        """
        if lines:
            self._make_own()
            hashed, seal = self._state[0].copy(), self._state[1]
            with named_errors(self._file):
                disk.write_at(self._file, seal.bytes, lines)
            hashed.update(lines)
            seal = TableSeal(
                lines=seal.lines + lines.count(b"\n"),
                bytes=seal.bytes + len(lines),
                sha256=hashed.hexdigest(),
            )
            self._state = (hashed, seal)  # one step, so that an interruption leaves the two in agreement

    def sync(self) -> None:
        """Forces the lines, and the name of a new table, to disk, and cuts off what stands behind them.

        Raises:
            StorageError: the operating system refuses the operation.
        """
        self._make_own()
        with named_errors(self._file):
            if self.has_more:
                disk.truncate(self._file, self.seal.bytes)
            disk.sync(self._file)
            if not self._is_named:
                disk.sync(self._file.parent)
        self._is_named = True

    def _make_own(self) -> None:
        """Keeps a copy of the dataset that shares the file by a link as it is."""
        make_own(self._file, num_bytes=self.seal.bytes, staging=self._file.parent / STAGING)

    @property
    def seal(self) -> TableSeal:
        """The seal of the lines; to be published after `sync`."""
        return self._state[1]

    @property
    def has_more(self) -> bool:
        """Whether the file holds more than the lines."""
        return self._file.stat().st_size > self.seal.bytes
