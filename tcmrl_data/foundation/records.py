"""Records as JSON files, and strict parsing of untrusted ones."""

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
"""Unicode categories of control, format and surrogate characters and of line separators."""

SMALL_RECORD = 2**16
"""Bytes of JSON up to which a record is validated once, whatever its errors cost; most parts' are 10 kB."""


class Record(BaseModel):
    """A record of a dataset: frozen; unknown keys, type conversions and NaN are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


Kind = TypeVar("Kind", bound=BaseModel)


def write_record(file: Path, record: BaseModel) -> None:
    """Writes a record as JSON, atomically.

    Raises:
        StorageError: the operating system refuses the operation; the old file is unchanged.
    """
    replace_file(file, record_bytes(record))


def record_bytes(record: BaseModel) -> bytes:
    """A record as the content of a JSON file."""
    return (record.model_dump_json(indent=1, by_alias=True) + "\n").encode()


def read_record(
    kind: type[Kind], file: Path, *, remedy: str = "", error: type[TcmrlError] = CheckpointError
) -> Kind:
    """Reads a record written by `write_record`.

    Args:
        kind: class of the record.
        file: the JSON file.
        remedy: end of the message if the content is not valid.
        error: class of the error to raise.

    Raises:
        TcmrlError: of class `error`: the file is missing, or its content is not a valid `kind`.
    """
    try:
        return kind.model_validate_json(file.read_bytes())
    except OSError as problem:
        raise error(f"{file} cannot be read: {problem.strerror}") from None
    except ValidationError as problem:
        raise error(f"{file}: {first_problem(problem)}{remedy}") from None


def parse_record(kind: type[Kind], values: Any, file: object, *, version: int) -> Kind:
    """Validates parsed JSON strictly as a record of a dataset.

    Raises:
        ManifestError: another schema version, control characters, or invalid values; the message names the
            file and the field.
    """
    found = values.get("schema_version") if isinstance(values, dict) else None
    if found != version or isinstance(found, bool):
        raise ManifestError(
            f"{file}: schema_version {repr(found)[:40]} is not {version}, which this version reads"
        )
    text = canonical_json(values)
    # canonical JSON escapes every character outside printable ASCII, except DEL
    hidden = hidden_text(values) if b"\\" in text or b"\x7f" in text else None
    if hidden:
        place = printable(hidden)[:200]
        raise ManifestError(f"{file}: {place} holds control characters, which a terminal would obey")
    try:
        # Errors of model_validate_json copy the input many times. Errors of model_validate refer to it,
        # so a large invalid record fails here, in little memory.
        if len(text) > SMALL_RECORD:
            kind.model_validate(_with_tuples(values))
        return kind.model_validate_json(text)
    except ValidationError as error:
        raise ManifestError(f"{file}: {printable(first_problem(error))[:500]}") from None


def _with_tuples(value: Any) -> Any:
    """Parsed JSON with tuples instead of lists, as strict validation of Python values requires."""
    if isinstance(value, dict):
        return {key: _with_tuples(member) for key, member in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


def hidden_text(value: Any, place: str = "") -> str | None:
    """The path of the first field whose name or text holds hidden characters."""
    if isinstance(value, str):
        return place if _is_hidden(value, allowed="\n\t") else None
    members = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, member in members:
        inner = f"{place}.{key}" if place else str(key)
        if isinstance(key, str) and _is_hidden(key, allowed=""):
            return inner
        found = hidden_text(member, inner)
        if found:
            return found
    return None


def _is_hidden(text: str, *, allowed: str) -> bool:
    return not text.isprintable() and any(
        unicodedata.category(character) in HIDDEN_CATEGORIES and character not in allowed
        for character in text
    )
