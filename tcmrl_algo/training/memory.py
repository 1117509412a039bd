"""The C library's allocator, set for steps that free and ask for the same large tensors again and again."""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Of glibc's malloc.h; other C libraries have no `mallopt`, or ignore these."""
LARGEST_TENSOR = 1 << 30
MOST_FREE = (1 << 31) - 1


def keep_freed_memory() -> None:
    """Lets the process keep freed memory for its next tensors, up to its own peak.

    glibc gives large tensors back to the kernel as soon as they are freed; asking for them anew costs one
    page fault per 4 KiB, which was a tenth of a training step's time at the paper's sizes.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_TENSOR)
        mallopt(M_TRIM_THRESHOLD, MOST_FREE)
