"""Times, medians and memory, for benchmarks."""

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

REPEATS = 5
Measured = dict[str, Any]


def seconds(run: Callable[[], object]) -> float:
    """Wall time of a call."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def forget(files: list[Path]) -> None:
    """Asks the system to drop files from the page cache."""
    for file in files:
        with file.open("rb") as opened:
            os.fsync(opened.fileno())
            os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def memory(name: str) -> int:
    """Bytes of this process: `VmRSS`, or `VmHWM`, the most that it had."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def median(values: list[float]) -> float:
    """The median with four digits."""
    return rounded(statistics.median(values))


def rounded(value: float) -> float:
    """A number with four digits."""
    return float(f"{value:.4g}")
