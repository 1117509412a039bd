"""Canonical JSON, which gives equal values equal digests, and a strict JSON parser."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

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
