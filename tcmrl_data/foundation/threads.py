"""How long threads wait for each other before they sleep."""

import os

SPINS = "1000"
"""On two cores that other programs share, a small training with two threads made 0.3 steps a second with GNU
OpenMP's default, which spins for milliseconds, and 13 with this: a spinning thread keeps the core from the
thread that it waits for. On idle cores both make 3 steps a second with networks of the paper's size, and 55
to 68 with small ones; threads that sleep at once make 33 of those.
"""


def sleep_soon() -> None:
    """Keeps OpenMP's threads from spinning for long, unless the environment says how they wait.

    Must run before torch is imported; processes started by this one inherit it.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
