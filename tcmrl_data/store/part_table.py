"""`parts.jsonl`: the parts of a dataset, one JSON array a line, in the order in which they were published.

The first line names the columns. In memory the table is a few NumPy columns, about 160 bytes a part, so that
datasets of a million parts open in seconds.
"""

import functools
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, FailFast, Field, TypeAdapter, ValidationError

from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.files import one_line, printable, read_plain_file
from tcmrl_data.foundation.records import canonical_json, first_problem, sha256
from tcmrl_data.store.part import PartRecord
from tcmrl_data.store.tables import MAX_COUNT, MAX_INDEX, MAX_PLATFORMS, RUN_NAME, SHA256, PartKey, blocks

PARTS_TABLE = "parts.jsonl"

_Index = Annotated[int, Field(ge=0, lt=MAX_INDEX)]
_Count = Annotated[int, Field(ge=0, lt=MAX_COUNT)]
_Sha256 = Annotated[str, Field(pattern=SHA256)]


class PartEntry(NamedTuple):
    """A line of the table: a part as it can be known without opening it.

    Attributes:
        id: digest of the part's identity.
        sha256: of the archive.
        size: of the archive in bytes.
        platform: position in the manifest's platforms.
        mean: of the undiscounted returns, like `std`, `min` and `max`.
        success_rate: null without a success signal.
        uniform: mean return of uniform actions on the task; `oracle` and `scripted` likewise, or null.
    """

    task: _Index
    step: _Index
    run: Annotated[str, Field(pattern=rf"^{RUN_NAME}$")]
    id: _Sha256
    sha256: _Sha256
    size: _Count
    platform: Annotated[int, Field(ge=0, lt=MAX_PLATFORMS)]
    episodes: _Count
    steps: _Count
    mean: float
    std: float
    min: float
    max: float
    success_rate: float | None
    uniform: float | None
    oracle: float | None
    scripted: float | None

    @property
    def key(self) -> PartKey:
        """The part's key."""
        return PartKey(self.task, self.step, self.run)


STATISTICS = ("episodes", "steps", "mean", "std", "min", "max", "success_rate")
REFERENCES = ("uniform", "oracle", "scripted")
HEADER = canonical_json(list(PartEntry._fields))

_ROWS: TypeAdapter[list[tuple[Any, ...]]] = TypeAdapter(
    Annotated[list[tuple[*PartEntry.__annotations__.values()]], FailFast()],  # type: ignore[misc, arg-type]
    config=ConfigDict(strict=True, allow_inf_nan=False),
)
_DTYPES: dict[str, Any] = {
    "task": np.int64,  # searchsorted would convert a narrower column at every look-up
    "step": np.int64,
    "platform": np.int16,
    "size": np.int64,
    "episodes": np.int64,
    "steps": np.int64,
} | dict.fromkeys(("mean", "std", "min", "max", "success_rate", *REFERENCES), np.float64)
_ROOT = np.dtype([("task", "<u4"), ("step", "<u4"), ("run", "S64"), ("id", "V32")])


def part_entry(record: PartRecord, *, run: str, platform: int, archive: bytes) -> PartEntry:
    """The line of a part."""
    identity, statistics, references = record.identity, record.statistics, record.references
    return PartEntry(
        identity.task,
        identity.step,
        run,
        record.id,
        sha256(archive),
        len(archive),
        platform,
        *(getattr(statistics, name) for name in STATISTICS),
        *(getattr(references, name) for name in REFERENCES),
    )


def part_line(entry: PartEntry) -> bytes:
    """A part as a line of the table."""
    return canonical_json(entry)


class PartTable:
    """The parts of a dataset, sorted by task, step and run.

    Attributes:
        runs: names of the runs that occur.
        columns: `task`, `step`, `run` (position in `runs`), `id` and `sha256` (32 bytes each), and all other
            fields of `PartEntry` as arrays of (parts,); null is NaN.
    """

    def __init__(self, runs: Sequence[str], columns: dict[str, npt.NDArray[Any]]) -> None:
        order = np.lexsort((_ranks(runs)[columns["run"]], columns["step"], columns["task"]))
        self.runs = tuple(runs)
        self.columns = {name: column[order] for name, column in columns.items()}

    @classmethod
    def empty(cls) -> "PartTable":
        """A table without parts."""
        return cls((), _columns_of((), {}))

    def __len__(self) -> int:
        return len(self.columns["task"])

    def __iter__(self) -> Iterator[PartKey]:
        return self._keys(slice(None))

    def __contains__(self, key: PartKey) -> bool:
        return self._row(key) is not None

    def keys_of(self, task: int) -> list[PartKey]:
        """The keys of a task's parts, ascending."""
        return list(self._keys(self._rows_of(task)))

    def entry(self, key: PartKey) -> PartEntry | None:
        """The line of a part; None if it is not in the table."""
        row = self._row(key)
        return None if row is None else next(self.entries(slice(row, row + 1)))

    def entries_of(self, task: int) -> list[PartEntry]:
        """The lines of a task's parts, ascending by key."""
        return list(self.entries(self._rows_of(task)))

    def entries(self, rows: slice = slice(None)) -> Iterator[PartEntry]:
        """The lines of some rows, of all where none are given, sorted by key."""
        values = {name: column[rows].tolist() for name, column in self.columns.items()}
        values["run"] = [self.runs[run] for run in values["run"]]
        for name in ("id", "sha256"):
            values[name] = [digest.hex() for digest in values[name]]
        for name in ("success_rate", *REFERENCES):
            values[name] = [None if math.isnan(value) else value for value in values[name]]
        return map(PartEntry._make, zip(*(values[name] for name in PartEntry._fields), strict=True))

    def with_entries(self, entries: Sequence[PartEntry]) -> "PartTable":
        """The table with further parts."""
        if not entries:
            return self
        runs = {run: position for position, run in enumerate(self.runs)}
        more = _columns_of(entries, runs)
        columns = {name: np.concatenate([column, more[name]]) for name, column in self.columns.items()}
        return PartTable(list(runs), columns)

    def without_tasks(self, tasks: Collection[int]) -> "PartTable":
        """The table without the parts of some tasks."""
        if not tasks:
            return self
        kept = ~np.isin(self.columns["task"], list(tasks))
        return PartTable(self.runs, {name: column[kept] for name, column in self.columns.items()})

    def only(self, keys: Collection[PartKey]) -> "PartTable":
        """The table of some of its parts; keys that it does not have count for nothing."""
        kept = np.fromiter((key in keys for key in self), dtype=np.bool_, count=len(self))
        used = np.unique(self.columns["run"][kept])
        columns = {name: column[kept] for name, column in self.columns.items()}
        columns["run"] = np.searchsorted(used, columns["run"]).astype(np.int32)
        return PartTable([self.runs[run] for run in used], columns)

    @functools.cached_property
    def root(self) -> str:
        """sha256 over all parts, sorted by task, step and run.

        A part counts with 104 bytes: task and step as little-endian 32 bit integers, the run's name filled up
        with zeros to 64 bytes, and its id.
        """
        records = np.zeros(len(self), dtype=_ROOT)
        for name in ("task", "step", "id"):
            records[name] = self.columns[name]
        records["run"] = np.array(self.runs, dtype="S64")[self.columns["run"]]
        return sha256(records.tobytes())

    def num_parts(self, run: str) -> int:
        """Number of parts of a run."""
        if run not in self.runs:
            return 0
        return int((self.columns["run"] == self.runs.index(run)).sum())

    def total(self, column: str) -> int:
        """Sum of a column of counts."""
        return int(self.columns[column].sum())

    def _keys(self, rows: slice) -> Iterator[PartKey]:
        columns = (self.columns[name][rows].tolist() for name in ("task", "step", "run"))
        return (PartKey(task, step, self.runs[run]) for task, step, run in zip(*columns, strict=True))

    def _rows_of(self, task: int) -> slice:
        first, last = np.searchsorted(self.columns["task"], [task, task + 1])
        return slice(int(first), int(last))

    def _row(self, key: PartKey) -> int | None:
        rows = self._rows_of(key.task)
        first, last = rows.start + np.searchsorted(self.columns["step"][rows], [key.step, key.step + 1])
        for row in range(int(first), int(last)):
            if self.runs[self.columns["run"][row]] == key.run:
                return row
        return None


def parse_parts(data: bytes, file: Path) -> PartTable:
    """The parts of a table's lines.

    Raises:
        ManifestError: lines that were not written here, or a part that stands there twice.
    """
    if not data.startswith(HEADER):
        raise ManifestError(f"{file}: its first line does not name the columns of this version")
    runs: dict[str, int] = {}
    chunks = [_columns(block, runs, file) for block in blocks(data[len(HEADER) :], file)]
    if not chunks:
        return PartTable.empty()
    columns = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    table = PartTable(list(runs), columns)
    if len(table) != data.count(b"\n") - 1:
        raise ManifestError(f"{file}: its lines do not hold one part each")
    keys = np.stack([table.columns[name] for name in ("task", "step", "run")])
    if (keys[:, 1:] == keys[:, :-1]).all(axis=0).any():
        raise ManifestError(f"{file}: a part stands there twice")
    return table


def parse_entries(data: bytes) -> list[PartEntry]:
    """The parts of complete lines without a header, up to the first line that is none."""
    entries = []
    for line in data.splitlines():
        try:
            entries.append(PartEntry(*_ROWS.validate_json(b"[" + line + b"]", strict=True)[0]))
        except (ValidationError, IndexError):
            break
    return entries


def _columns_of(rows: Iterable[Sequence[Any]], runs: dict[str, int]) -> dict[str, npt.NDArray[Any]]:
    """The columns of a `PartTable` for lines in any order; adds the runs that occur to `runs`."""
    named = dict(zip(PartEntry._fields, zip(*rows, strict=True), strict=False))
    columns: dict[str, npt.NDArray[Any]] = {
        name: np.array(named.get(name, ()), dtype=dtype) for name, dtype in _DTYPES.items()
    }
    for name in ("id", "sha256"):
        columns[name] = np.frombuffer(bytes.fromhex("".join(named.get(name, ()))), dtype="V32")
    names = named.get("run", ())
    for run in dict.fromkeys(names):
        runs.setdefault(run, len(runs))
    columns["run"] = np.array([*map(runs.__getitem__, names)], dtype=np.int32)
    return columns


def _columns(block: bytes, runs: dict[str, int], file: Path) -> dict[str, npt.NDArray[Any]]:
    try:
        return _columns_of(_ROWS.validate_json(block, strict=True), runs)
    except ValidationError as error:
        raise ManifestError(f"{file}: {printable(first_problem(error))[:500]}") from None


def _ranks(runs: Sequence[str]) -> npt.NDArray[np.int64]:
    return np.argsort(np.argsort(np.array(runs, dtype=np.str_)))


def read_part(file: Path, entry: PartEntry) -> bytes:
    """The bytes of a part's archive, compared with its line of the table.

    Raises:
        StoreError: the archive is missing or damaged.
    """
    remedy = "run `tcmrl-data verify --repair`"
    try:
        data = read_plain_file(file, limit=entry.size)
    except (OSError, ValueError) as error:
        raise StoreError(f"{file}: {one_line(error)}; {remedy}") from None
    if sha256(data) != entry.sha256:
        raise StoreError(f"{file} does not have the recorded sha256; {remedy}")
    return data
