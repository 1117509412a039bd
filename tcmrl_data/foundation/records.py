"""Records as JSON files, and the strict reading of a stranger's: no text that a terminal would obey."""

import unicodedata
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import CheckpointError, ManifestError, TcmrlError
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.foundation.validation import first_problem

HIDDEN_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories of control, direction and surrogate characters and of line separators."""


class Record(BaseModel):
    """A record of a dataset: frozen, no unknown keys, no conversion of types, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


Kind = TypeVar("Kind", bound=BaseModel)


def write_record(file: Path, record: BaseModel) -> None:
    """Writes a record as JSON, in one step.

    Raises:
        StorageError: the disk refuses; the old file stands.
    """
    replace_file(file, record_bytes(record))


def record_bytes(record: BaseModel) -> bytes:
    """A record as the text of a JSON file."""
    return (record.model_dump_json(indent=1, by_alias=True) + "\n").encode()


def read_record(
    kind: type[Kind], file: Path, *, remedy: str = "", error: type[TcmrlError] = CheckpointError
) -> Kind:
    """Takes back what `write_record` wrote.

    Args:
        kind: what it is a record of.
        file: where.
        remedy: ends the message where the content is no such record.
        error: the kind of error to raise; a training run's by default.

    Raises:
        TcmrlError: of the given kind: the file is missing, or is not such a record.
    """
    try:
        return kind.model_validate_json(file.read_bytes())
    except OSError as problem:
        raise error(f"{file} cannot be read: {problem.strerror}") from None
    except ValidationError as problem:
        raise error(f"{file}: {first_problem(problem)}{remedy}") from None


def parse_record(kind: type[Kind], values: Any, file: Path, *, version: int) -> Kind:
    """A dataset's record of parsed JSON, validated strictly.

    Raises:
        ManifestError: another schema version, hidden text, or values that do not validate; names file
            and field.
    """
    found = values.get("schema_version") if isinstance(values, dict) else None
    if found != version or isinstance(found, bool):
        raise ManifestError(
            f"{file}: schema_version {repr(found)[:40]} is not {version}, which this version reads"
        )
    text = canonical_json(values)
    # canonical JSON escapes whatever is not printable ASCII, but for DEL
    hidden = _hidden_text(values) if b"\\" in text or b"\x7f" in text else None
    if hidden:
        place = printable(hidden)[:200]
        raise ManifestError(f"{file}: {place} holds control characters, which a terminal would obey")
    try:
        # errors over JSON text copy what they complain of, over and over; these refer to it
        kind.model_validate(_with_tuples(values))
        return kind.model_validate_json(text)
    except ValidationError as error:
        raise ManifestError(f"{file}: {printable(first_problem(error))[:500]}") from None


def _with_tuples(value: Any) -> Any:
    """Parsed JSON as strict validation of Python values wants it."""
    if isinstance(value, dict):
        return {key: _with_tuples(each) for key, each in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


def _hidden_text(value: Any, place: str = "") -> str | None:
    """The field whose name or text holds hidden characters."""
    if isinstance(value, str):
        return place if _is_hidden(value, allowed="\n\t") else None
    members = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, each in members:
        inner = f"{place}.{key}" if place else str(key)
        if isinstance(key, str) and _is_hidden(key, allowed=""):
            return inner
        found = _hidden_text(each, inner)
        if found:
            return found
    return None


def _is_hidden(text: str, *, allowed: str) -> bool:
    return not text.isprintable() and any(
        unicodedata.category(each) in HIDDEN_CATEGORIES and each not in allowed for each in text
    )
