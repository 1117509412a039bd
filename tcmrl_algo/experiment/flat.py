"""Tables of results as CSV files: one dataclass per table, one field per column."""

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_type_hints

from tcmrl_algo.experiment.compact import DIGITS
from tcmrl_data import CheckpointError
from tcmrl_data.foundation.disk import make_folders, replace_file

YES = "yes"
Row = TypeVar("Row")


def read_table(kind: type[Row], file: Path) -> list[Row]:
    """The rows of a CSV file as dataclasses; an empty cell is None, or False.

    Raises:
        CheckpointError: no such file, other columns than the fields of `kind`, or a cell of another type.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise CheckpointError(f"{file}: {error.strerror}") from None
    reader, parsers = csv.DictReader(io.StringIO(text)), _parsers(kind)
    if reader.fieldnames != list(parsers):
        raise CheckpointError(f"{file} has columns {reader.fieldnames}; they must be {list(parsers)}")
    rows = []
    for values in reader:
        try:
            rows.append(kind(**{column: parse(values[column]) for column, parse in parsers.items()}))
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"{file}, line {reader.line_num}: {error}") from None
    return rows


def write_table(kind: type[Row], file: Path, rows: Iterable[Row]) -> None:
    """Writes dataclasses as a CSV file, floats with six significant digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = list(_parsers(kind))
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(getattr(row, column)) for column in columns])
    make_folders(file.parent)
    replace_file(file, stream.getvalue().encode())


def merged(old: Iterable[Row], new: Iterable[Row], key: Callable[[Row], Any]) -> list[Row]:
    """Rows of both, sorted by their keys; a new row takes the place of the old one of its key."""
    rows = {key(row): row for row in (*old, *new)}
    return [rows[place] for place in sorted(rows, key=str)]


def _parsers(kind: type[Any]) -> dict[str, Callable[[str], Any]]:
    hints = get_type_hints(kind)
    return {field.name: _parser(hints[field.name]) for field in dataclasses.fields(kind)}


def _parser(hint: Any) -> Callable[[str], Any]:
    if isinstance(hint, UnionType):
        (inner,) = (part for part in get_args(hint) if part is not type(None))
        return lambda text: inner(text) if text else None
    if hint is bool:
        return {YES: True, "": False}.__getitem__
    parse: Callable[[str], Any] = hint
    return parse


def _cell(value: Any) -> str:
    if value is None or value is False:
        return ""
    if value is True:
        return YES
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)
