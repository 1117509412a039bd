"""Canonical JSON, which gives equal values equal digests; records as JSON files; strict parsing of both."""

import difflib
import hashlib
import json
import math
import re
import types
import typing
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import CheckpointError, ManifestError, TcmrlError
from tcmrl_data.foundation.files import printable

MAX_JSON_BYTES = 16 * 2**20

MAX_JSON_VALUES = 2**17
"""An empty list takes 3 bytes of text and 64 of memory."""

MAX_JSON_DEPTH = 32


def canonical_json(value: Any) -> bytes:
    """JSON with sorted keys, no spaces, ASCII only, no NaN, and floats in the shortest round-trip form."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.encode("ascii") + b"\n"


def sha256(data: bytes | memoryview) -> str:
    """The sha256 of data, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def digest(value: Any) -> str:
    """The sha256 of a value's canonical JSON, in hexadecimal."""
    return sha256(canonical_json(value))


def leaves(tables: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of every value within nested tables; an empty table counts as a value."""
    for key, value in tables.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


def differences(left: Any, right: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Place, such as `sac.steps`, and both values of everything that differs in two JSON values.

    A key that one object lacks has the value None there; lists are compared whole.
    """
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        for name in sorted({*left, *right}):
            inner = f"{place}.{name}" if place else str(name)
            yield from differences(left.get(name), right.get(name), inner)
    elif left != right:
        yield place, left, right


def parse_json(data: bytes) -> Any:
    """Parses untrusted JSON; limits size, number of values and depth.

    Raises:
        ValueError: the data exceeds a limit, is invalid JSON, or holds duplicate keys, NaN or infinity. The
            message does not name the file; callers add the name.
    """
    if len(data) > MAX_JSON_BYTES:
        raise ValueError(f"{len(data)} bytes of JSON exceed the limit of {MAX_JSON_BYTES}")
    if sum(map(data.count, (b",", b"[", b"{"))) > MAX_JSON_VALUES:
        raise ValueError(f"JSON holds more than {MAX_JSON_VALUES} values")
    if _depth(data) > MAX_JSON_DEPTH:
        raise ValueError(f"JSON is nested deeper than {MAX_JSON_DEPTH}")
    return json.loads(
        data.decode("utf-8"),
        object_pairs_hook=_unique,
        parse_constant=_no_constant,
        parse_float=_finite,
    )


def _depth(data: bytes) -> int:
    """An upper bound of the nesting depth, computed without recursion; it counts brackets in strings too."""
    depth = deepest = 0
    for byte in data.translate(None, delete=_NO_BRACKETS):
        if byte in b"[{":
            depth += 1
            deepest = max(deepest, depth)
        else:
            depth -= 1
    return deepest


_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        seen: set[str] = set()
        duplicate = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"duplicate key {duplicate[:80]!r}")
    return result


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not allowed")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is too large for a number")
    return value


HIDDEN_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories of control, format and surrogate characters and of line separators."""

SMALL_RECORD = 2**16
"""Bytes of JSON up to which a record is validated once, whatever its errors cost; most parts' are 10 kB."""


class Frozen(BaseModel):
    """Settings, or a record: frozen; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Record(Frozen):
    """A record of a dataset: type conversions and NaN are errors, too."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)


Kind = TypeVar("Kind", bound=BaseModel)
Value = TypeVar("Value")


def as_model(kind: type[Kind], values: Any) -> Kind:
    """Parsed JSON as a model; strict, except that a list is taken for a tuple, which JSON has no word for."""
    return kind.model_validate_json(canonical_json(values))


def to_json(value: Any) -> Any:
    """A dataclass of models, paths and plain values as JSON, which `from_json` reads."""
    return TypeAdapter(type(value)).dump_python(value, mode="json")


def from_json(kind: type[Value], values: Any) -> Value:
    """The dataclass that `to_json` wrote."""
    return TypeAdapter(kind).validate_json(canonical_json(values))


def write_record(file: Path, record: BaseModel) -> None:
    """Writes a record as JSON, atomically."""
    replace_file(file, record_bytes(record))


def record_bytes(record: BaseModel) -> bytes:
    """A record as the content of a JSON file."""
    return (record.model_dump_json(indent=1, by_alias=True) + "\n").encode()


def read_record(kind: type[Kind], file: Path, *, remedy: str = "") -> Kind:
    """Reads a record written by `write_record`; raises `CheckpointError` where that cannot be done."""
    try:
        return kind.model_validate_json(file.read_bytes())
    except OSError as problem:
        raise CheckpointError(f"{file} cannot be read: {problem.strerror}") from None
    except ValidationError as problem:
        raise CheckpointError(f"{file}: {first_problem(problem)}{remedy}") from None


def sealed(fields: Mapping[str, Any]) -> bytes:
    """The bytes of a record that holds its own digest: canonical JSON, with that of all other fields."""
    return canonical_json({**fields, "digest": digest(fields)})


def parse_record(
    kind: type[Kind], values: Any, file: object, *, version: int, data: bytes | None = None
) -> Kind:
    """Validates parsed JSON strictly as a record of a dataset.

    Args:
        data: the file's content where it holds its own digest, which is compared before anything else.

    Raises:
        ManifestError: another schema version, another digest, control characters, or invalid values; the
            message names the file and the field.
    """
    found = values.get("schema_version") if isinstance(values, dict) else None
    if found != version or isinstance(found, bool):
        raise ManifestError(
            f"{file}: schema_version {repr(found)[:40]} is not {version}, which this version reads"
        )
    if data is not None and sealed({key: values[key] for key in values if key != "digest"}) != data:
        raise ManifestError(f"{file}: digest does not match its contents; the file was edited or damaged")
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


Table = TypeVar("Table", bound=BaseModel)


def validate_table(
    kind: type[Table], values: Mapping[str, Any], *, place: str, error: type[TcmrlError], table: str = ""
) -> Table:
    """Validates a table strictly, except that a list is accepted for a tuple.

    Args:
        place: origin of the table, for the error message.
        table: dotted path of the table within its origin.

    Raises:
        TcmrlError: of class `error`, with the first problem in one line.
    """
    try:
        return kind.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as problem:
        raise error(f"{place}: {first_problem(problem, kind=kind, table=table)}") from None


def missing_fields(kind: type[BaseModel], values: Mapping[str, Any], *, table: str) -> list[str]:
    """The fields of a settings class that have no default and no value, by dotted names."""
    fields = {field.alias or name: field for name, field in kind.model_fields.items()}
    return [f"{table}.{name}" for name, field in fields.items() if field.is_required() and name not in values]


def first_problem(error: ValidationError, *, kind: type[BaseModel] | None = None, table: str = "") -> str:
    """The first problem of a validation error in one line: field, rule, value.

    Args:
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


_RANGE = re.compile(r"(0|[1-9][0-9]{0,9})(?:-([1-9][0-9]{0,9}))?")


def write_ranges(indices: Iterable[int]) -> str:
    """The text of some indices, ascending, each once; empty where there is none.

    Example:
        >>> write_ranges([12, 0, 1, 2])
        '0-2,12'
    """
    ranges: list[list[int]] = []
    for index in sorted(set(indices)):
        if ranges and ranges[-1][1] == index - 1:
            ranges[-1][1] = index
        else:
            ranges.append([index, index])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)


def read_ranges(text: str, *, limit: int) -> list[int]:
    """The inverse of `write_ranges`, for text of unknown origin.

    Raises:
        ValueError: the text is not one that `write_ranges` gives, or an index is too large.
    """
    return [index for first, last in _spans(text, limit) for index in range(first, last + 1)]


def count_ranges(text: str, *, limit: int) -> int:
    """The number of indices in a text, without making a list of them; arguments and errors as above."""
    return sum(last - first + 1 for first, last in _spans(text, limit))


def _spans(text: str, limit: int) -> list[tuple[int, int]]:
    spans: list[tuple[int, int]] = []
    for item in text.split(",") if text else ():
        match = _RANGE.fullmatch(item)
        if match is None:
            raise ValueError(f"{item[:40]!r} is neither an index nor a range such as 0-9")
        first, last = int(match[1]), int(match[2] or match[1])
        if (match[2] and last <= first) or last >= limit or (spans and first <= spans[-1][1] + 1):
            raise ValueError(f"{text[:80]!r} does not hold ascending ranges of indices below {limit}")
        spans.append((first, last))
    return spans
