"""What every record of a dataset is validated with: strictly, and without text that a terminal would obey."""

import unicodedata
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.recipe.recipe import first_problem

HIDDEN_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories of control, direction and surrogate characters and of line separators."""


class Record(BaseModel):
    """Frozen, no unknown keys, no conversion of types, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


Kind = TypeVar("Kind", bound=Record)


def validated(kind: type[Kind], values: Any, file: Path, *, version: int) -> Kind:
    """A record of parsed JSON.

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
