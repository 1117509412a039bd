"""Keys of parts, limits of datasets, and tables: files of JSON lines whose beginning the manifest seals.

A build appends a line per published part, which takes the same time however many there are, and seals what
stands there from time to time. Lines behind the sealed ones are its log: after a crash the next build reads
them again. Readers read the sealed lines only. The table of tasks is here, that of parts in `part_table.py`.
"""

import hashlib
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import FailFast, Field, TypeAdapter, ValidationError

from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.disk import STAGING, disk, make_own, named_errors
from tcmrl_data.foundation.errors import BuildError, ManifestError, TaskError
from tcmrl_data.foundation.files import one_line, open_plain_file, printable
from tcmrl_data.foundation.records import Record, canonical_json, first_problem, hidden_text, parse_json

MAIN_RUN = "main"
RUN_NAME = r"[a-z0-9_-]{1,64}"
SHA256 = r"^[0-9a-f]{64}$"
PARTS = "parts"
"""Folder of the parts' archives."""

_PART_FOLDER = re.compile(rf"{PARTS}(?:/{RUN_NAME}(?:/[0-9]{{5,10}})?)?")
_PART_FILE = re.compile(rf"{PARTS}/({RUN_NAME})/([0-9]{{5,10}})/([0-9]{{7,10}})\.zip")


class PartKey(NamedTuple):
    """What a part is called within a dataset; keys are sorted by task, step and run."""

    task: int
    step: int
    run: str = MAIN_RUN

    def __str__(self) -> str:
        return f"task {self.task}, step {self.step}, run {self.run}"


def part_file(key: PartKey) -> str:
    """Path of a part's archive, relative to the dataset."""
    return f"{part_folder(key)}/{key.step:07d}.zip"


def part_folder(key: PartKey) -> str:
    """Path of the folder that holds the archives of a task and run, relative to the dataset."""
    return f"{PARTS}/{key.run}/{key.task:05d}"


def is_part_folder(path: str) -> bool:
    """Whether a relative path is that of a folder of parts: of all, of a run or of a task."""
    return _PART_FOLDER.fullmatch(path) is not None


def key_of_file(path: str) -> PartKey | None:
    """The inverse of `part_file`; None for the path of anything else."""
    match = _PART_FILE.fullmatch(path)
    key = PartKey(int(match[2]), int(match[3]), match[1]) if match else None
    return key if key is not None and part_file(key) == path else None


MAX_PARTS = 1_000_000
MAX_TASKS = 100_000
MAX_STEPS = 2**14
"""Snapshot steps of a run; the manifest and every part's record list them."""
MAX_RUNS = 1_000
MAX_PLATFORMS = 1_000

MAX_INDEX = 2**31
"""Task indices and snapshot steps lie below this."""

MAX_COUNT = 2**40
"""Numbers of episodes, steps and bytes lie below this."""

MAX_ARRAYS = 32
MAX_COLUMNS = 2**14
"""Width of observations and actions; a part's record holds two sums per column."""

LINE_BYTES = 2**16
"""A line of a table; the parameters of a task must fit into it."""

PART_RECORD_BYTES = 2**21


def check_plan(*, tasks: int, steps: int, columns: int, largest_task: int) -> None:
    """Checks that a dataset will not become larger than readers allow.

    Args:
        columns: width of observations or actions, whichever is larger.
        largest_task: bytes of the longest line of a task.
    """
    for what, found, limit in (
        ("tasks", tasks, MAX_TASKS),
        ("snapshot steps", steps, MAX_STEPS),
        ("parts", tasks * steps, MAX_PARTS),
        ("columns of observations or actions", columns, MAX_COLUMNS),
        ("bytes for the parameters of one task", largest_task, LINE_BYTES),
    ):
        if found > limit:
            raise BuildError(
                f"the dataset would have {found:,} {what}, more than the {limit:,} that a dataset may have"
            )


BLOCK_BYTES = 2**20
"""Lines are parsed in blocks of about this size, so that parsed lines take little memory."""


class TableSeal(Record):
    """The lines of a table that belong to the dataset; what follows in the file is the log of a build."""

    lines: int = Field(ge=0)
    bytes: int = Field(ge=0, lt=MAX_COUNT)
    sha256: str = Field(pattern=SHA256)


def read_sealed(file: Path, seal: TableSeal) -> bytes:
    """The sealed lines of a table; raises `ManifestError` for a file that is missing or damaged."""
    data = read_lines(file, seal.bytes)
    found = hashlib.sha256(data).hexdigest()
    if len(data) != seal.bytes or found != seal.sha256 or data.count(b"\n") != seal.lines:
        raise ManifestError(
            f"{file}: its first {seal.bytes} bytes are not those that the manifest seals; "
            "run `tcmrl-data verify --repair`"
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
    """Splits lines into JSON arrays of many lines each; raises `ManifestError` where one is too long."""
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
        raise ManifestError(f"{file} is missing; run `tcmrl-data verify --repair`") from None
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
        """Writes complete lines behind the others; not forced to disk before they are sealed."""
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
        """Forces the lines, and the name of a new table, to disk, and cuts off what stands behind them."""
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


TASKS = "tasks.jsonl"


class TaskRecord(Record):
    """A task of the dataset."""

    index: int = Field(ge=0, lt=MAX_INDEX)
    split: Literal["train", "test"]
    parameters: dict[str, Any]


_RECORDS = TypeAdapter(Annotated[list[TaskRecord], FailFast()])


def task_line(task: Task) -> bytes:
    """A task as a line of the table."""
    return canonical_json({"index": task.index, "split": task.split, "parameters": dict(task.parameters)})


def parse_tasks(data: bytes, file: Path) -> tuple[Task, ...]:
    """The tasks of a table's lines, ascending by index.

    Raises:
        ManifestError: lines that were not written here, or a task that stands there twice.
    """
    tasks = [
        Task(record.index, record.split, record.parameters)
        for block in blocks(data, file)
        for record in _parse_block(block, file)
    ]
    if not _is_canonical(tasks, data):
        raise ManifestError(f"{file}: its lines are not written as canonical JSON")
    ordered = sorted(tasks, key=lambda task: task.index)
    if len({task.index for task in tasks}) < len(tasks):
        raise ManifestError(f"{file}: a task stands there twice")
    return tuple(ordered)


def _is_canonical(tasks: Iterable[Task], data: bytes) -> bool:
    try:
        return b"".join(map(task_line, tasks)) == data
    except ValueError:  # NaN or infinity in a task's parameters
        return False


def parse_task_file(data: bytes, file: Path) -> list[Task]:
    """The tasks of a JSON list that a user wrote: `[{"index": 0, "split": "train", "parameters": {}}]`.

    Raises:
        TaskError: it is no such list, or a task stands there twice.
    """
    try:
        records = _RECORDS.validate_python(parse_json(data), strict=True)
    except ValidationError as error:
        raise TaskError(f"{file}: {printable(first_problem(error))[:500]}") from None
    except ValueError as error:
        raise TaskError(f"{file}: not JSON ({one_line(error)})") from None
    tasks = [Task(record.index, record.split, record.parameters) for record in records]
    if len({task.index for task in tasks}) < len(tasks):
        raise TaskError(f"{file}: a task stands there twice")
    if hidden := hidden_text([task.parameters for task in tasks]):
        raise TaskError(f"{file}: {printable(hidden)[:200]} holds control characters")
    return tasks


def _parse_block(block: bytes, file: Path) -> Iterable[TaskRecord]:
    try:
        records = _RECORDS.validate_json(block, strict=True)
    except ValidationError as error:
        raise ManifestError(f"{file}: {printable(first_problem(error))[:500]}") from None
    # canonical JSON escapes every character outside printable ASCII, except DEL
    if b"\\" in block or b"\x7f" in block:
        hidden = hidden_text([record.parameters for record in records])
        if hidden:
            place = printable(hidden)[:200]
            raise ManifestError(f"{file}: {place} holds control characters, which a terminal would obey")
    return records
