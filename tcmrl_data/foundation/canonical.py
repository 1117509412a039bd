"""Canonical JSON: one byte string per value, so that digests mean something, and a strict reader."""

import hashlib
import json
import math
from typing import Any, NoReturn

MAX_JSON_BYTES = 16 * 2**20

MAX_JSON_VALUES = 2**17
"""About 26,000 parts in a manifest. An empty list takes 3 bytes of text and 64 of memory."""

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
    """Parses JSON of a stranger: bounded in size, values and depth; no duplicate keys, NaN or infinity.

    Raises:
        ValueError: what is wrong, without the file's name; callers add it.
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
    """An upper bound on nesting, without recursion: brackets inside strings only make it stricter."""
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
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"duplicate key {twice[:80]!r}")
    return result


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not allowed")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is too large for a number")
    return value
