"""Formatting and parsing of sizes in bytes."""

import re

from tcmrl_data.foundation.errors import CacheError

UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def size(num_bytes: float) -> str:
    """A number of bytes as text in decimal units, such as `12.3 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if num_bytes < 1_000:
            return f"{num_bytes:.0f} B" if unit == "B" else f"{num_bytes:.1f} {unit}"
        num_bytes /= 1_000
    return f"{num_bytes:.1f} TB"


def parse_bytes(text: str) -> int:
    """Parses a size such as `2G`, `500M` or `1.5 GB` (decimal units) into bytes.

    Raises:
        CacheError: the text is not a size above 0.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kKMGT]?)B?", text.strip())
    num_bytes = int(float(match[1]) * UNITS[match[2].replace("K", "k")]) if match else 0
    if num_bytes < 1:
        raise CacheError(
            f"{text!r} is no size; write a number above 0 and one of B, k, M, G, T (powers of 1,000), "
            "such as 500M or 2G"
        )
    return num_bytes
