"""Validation of configuration tables, with one-line errors that suggest names for unknown keys."""

import difflib
import json
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from tcmrl_data.foundation.errors import TcmrlError

Table = TypeVar("Table", bound=BaseModel)


def validate_table(
    kind: type[Table], values: Mapping[str, Any], *, place: str, error: type[TcmrlError], table: str = ""
) -> Table:
    """Validates a table strictly, except that a list is accepted for a tuple.

    Args:
        kind: the settings class.
        values: the table, as parsed from TOML.
        place: origin of the table, for the error message.
        error: class of the error to raise.
        table: dotted path of the table within its origin.

    Raises:
        TcmrlError: of class `error`, with the first problem in one line.
    """
    try:
        return kind.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as problem:
        raise error(f"{place}: {first_problem(problem, kind=kind, table=table)}") from None


def first_problem(error: ValidationError, *, kind: type[BaseModel] | None = None, table: str = "") -> str:
    """The first problem of a validation error in one line: field, rule, value.

    Args:
        error: the error raised by pydantic.
        kind: the settings class; if given, the message for an unknown key suggests similar keys.
        table: dotted path to put in front of the field.
    """
    detail = error.errors()[0]
    place = detail["loc"]
    field = ".".join([*filter(None, [table]), *map(str, place)]) or "values"
    more = "" if error.error_count() == 1 else f" (and {error.error_count() - 1} more)"
    if kind is not None and detail["type"] == "extra_forbidden":
        return f"unknown key {field}; {nearest(str(place[-1]), known_keys(kind, place[:-1]))}{more}"
    given = "" if detail["type"] in ("missing", "value_error") else f", got {str(detail['input'])[:80]!r}"
    return f"{field}: {detail['msg']}{given}{more}"


def nearest(name: str, known: Iterable[str]) -> str:
    """A suggestion of known names, for the end of an error message about an unknown name."""
    names = sorted(known)
    found = difflib.get_close_matches(name, names, n=3)
    return f"did you mean {', '.join(found)}?" if found else f"known are {', '.join(names)}"


def known_keys(kind: Any, place: Sequence[str | int]) -> list[str]:
    """The keys that a nested table of a settings class may have; empty if the value is not a table.

    Args:
        kind: a settings class, or the type of one of its fields.
        place: keys and indices that lead from `kind` to the nested table.
    """
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        fields = {field.alias or name: field.annotation for name, field in kind.model_fields.items()}
        if not place:
            return list(fields)
        return known_keys(fields.get(str(place[0])), place[1:])
    members = [member for member in typing.get_args(kind) if member is not Ellipsis]
    if typing.get_origin(kind) in (typing.Union, types.UnionType, typing.Annotated):
        return next(filter(None, (known_keys(member, place) for member in members)), [])
    return known_keys(members[-1], place[1:]) if members and place else []
