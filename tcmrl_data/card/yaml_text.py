"""YAML of plain values: block lists and mappings, with texts quoted as in JSON, which is YAML too."""

import json
from collections.abc import Mapping, Sequence
from typing import Any


def yaml_text(value: Mapping[str, Any] | Sequence[Any], *, indent: int = 0) -> str:
    """A mapping or list as YAML, every line with its line end.

    Args:
        value: mappings with plain names as keys, lists, and JSON scalars; mappings and lists are not empty.
        indent: spaces in front of every line.
    """
    space = " " * indent
    if isinstance(value, Mapping):
        return "".join(f"{space}{key}:{_behind(member, indent + 2)}" for key, member in value.items())
    return "".join(f"{space}-{_item(member, indent + 2)}" for member in value)


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, str | bool | int | float)


def _behind(value: Any, indent: int) -> str:
    return f" {scalar(value)}\n" if _is_scalar(value) else f"\n{yaml_text(value, indent=indent)}"


def _item(value: Any, indent: int) -> str:
    """An item of a list, whose first line stands behind the dash."""
    return f" {scalar(value)}\n" if _is_scalar(value) else f" {yaml_text(value, indent=indent).lstrip()}"


def scalar(value: Any) -> str:
    """A JSON scalar in one line; YAML takes no unprintable characters, and no surrogates, as JSON does."""
    if not isinstance(value, str):
        return json.dumps(value)
    quoted = json.dumps(value, ensure_ascii=False)
    return "".join(
        character if character.isprintable() else f"\\U{ord(character):08x}" for character in quoted
    )
