"""Indices as text such as `0-9,12`, which is how records hold them."""

import re
from collections.abc import Iterable

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

    Args:
        text: the text.
        limit: indices lie below it.

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
