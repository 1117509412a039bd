"""Bounds within which a forged file may be read: of memory and of time."""

import contextlib
import gc
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

MEMORY_FLOOR = 64 * 2**20
"""What a case may make the process grow by, beside a multiple of its size on disk."""

ADDRESS_SPACE = 2**30
"""What a case may at most ask for, touched or not; a larger request fails as it would on a full machine."""

SECONDS = 240
"""After which a case counts as blocked; the slowest takes a few."""


def resident_bytes(field: str) -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(field))
    return int(line.split()[1]) * 1024


@contextlib.contextmanager
def ringing(seconds: int) -> Iterator[None]:
    """Fails what takes longer."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"blocked for {seconds} s")

    old = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)


@contextlib.contextmanager
def bounded(num_bytes: int, *, ratio: int) -> Iterator[None]:
    """Fails if the block hangs, or takes more memory than the floor and `ratio` times `num_bytes`."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak of resident memory
    resident = resident_bytes("VmRSS")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (resident_bytes("VmSize") + ADDRESS_SPACE, limits[1]))
    try:
        with ringing(SECONDS):
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert resident_bytes("VmHWM") - resident <= MEMORY_FLOOR + ratio * num_bytes
