"""The comments of a TOML text by key; in recipes they say where a value comes from."""

import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

KeyPath = tuple[str, ...]


def read_comments(text: str) -> dict[KeyPath, str]:
    """The comment of every value of a valid TOML text, empty where there is none.

    A value's comment is the one behind it; where there is none, the lines of comment directly above it;
    where there are none, the lines of comment directly below the header of its table.
    """
    comments: dict[KeyPath, str] = {}
    table: KeyPath = ()
    above: list[str] = []
    of_table, below_header = "", False
    for statement in _statements(text):
        if statement.startswith("#"):
            above.append(statement.lstrip("#").strip())
            continue
        parsed = _parse(statement)
        if statement.startswith("["):
            table, of_table = next(leaf_paths(parsed), ()), ""
        elif statement:
            of_table = " ".join(above) if below_header else of_table
            comment = _comment_behind(statement, parsed) or " ".join(above) or of_table
            comments |= {(*table, *path): comment for path in leaf_paths(parsed)}
        below_header = statement.startswith("[")
        above = []
    return comments


def leaf_paths(tables: Mapping[str, Any]) -> Iterator[KeyPath]:
    """The path of every value within nested tables; an empty table counts as a value."""
    for key, value in tables.items():
        if isinstance(value, Mapping) and value:
            yield from ((key, *path) for path in leaf_paths(value))
        else:
            yield (key,)


def _statements(text: str) -> Iterator[str]:
    """Comment lines, headers and assignments, the latter over as many lines as they take; or empty lines."""
    lines: list[str] = []
    for line in text.splitlines():
        lines.append(line.strip() if not lines else line)
        statement = "\n".join(lines)
        if _parse(statement) is not None:
            yield statement
            lines = []


def _parse(statement: str) -> Any:
    """What a text says, or None where it is not complete."""
    try:
        return tomllib.loads(statement)
    except tomllib.TOMLDecodeError:
        return None


def _comment_behind(statement: str, parsed: Any) -> str:
    """The comment at the end of an assignment."""
    for position, character in enumerate(statement):
        if character == "#" and _parse(statement[:position]) == parsed:  # no part of a string or of a list
            return statement[position + 1 :].strip()
    return ""
