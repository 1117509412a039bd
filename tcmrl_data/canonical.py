"""Canonical JSON: one byte string per value, so that digests mean something, and a strict reader."""

import hashlib
import json
from typing import Any, NoReturn

MAX_JSON_BYTES = 64 * 2**20
MAX_JSON_DEPTH = 32


def canonical_json(value: Any) -> bytes:
    """Sorted keys, no spaces, ASCII, no NaN; floats in Python's shortest round-trip form."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.encode("ascii") + b"\n"


def sha256(data: bytes | memoryview) -> str:
    """Hexadecimal sha256."""
    return hashlib.sha256(data).hexdigest()


def digest(value: Any) -> str:
    """sha256 of a value's canonical JSON."""
    return sha256(canonical_json(value))


def parse_json(data: bytes) -> Any:
    """Parses JSON of a stranger: size and depth bounded, no duplicate keys, no NaN or infinity.

    Raises:
        ValueError: what is wrong, without the file's name; callers add it.
    """
    if len(data) > MAX_JSON_BYTES:
        raise ValueError(f"{len(data)} bytes of JSON exceed the limit of {MAX_JSON_BYTES}")
    if _depth(data) > MAX_JSON_DEPTH:
        raise ValueError(f"JSON is nested deeper than {MAX_JSON_DEPTH}")
    return json.loads(data.decode("utf-8"), object_pairs_hook=_unique, parse_constant=_no_constant)


def _depth(data: bytes) -> int:
    """An upper bound on nesting, without recursion: brackets inside strings only make it stricter."""
    depth = deepest = 0
    for byte in data:
        if byte in b"[{":
            depth += 1
            deepest = max(deepest, depth)
        elif byte in b"]}":
            depth -= 1
    return deepest


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"duplicate key {next(key for key in keys if keys.count(key) > 1)!r}")
    return result


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not allowed")
