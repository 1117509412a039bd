"""Hypothesis strategies for episodes."""

import numpy as np
from hypothesis import strategies as st

from tcmrl_data import Trajectory


@st.composite
def trajectories(draw: st.DrawFn, *, min_steps: int = 0, max_steps: int = 12) -> Trajectory:
    """One episode of any length, ended by termination or truncation; with 0 steps by neither."""
    steps = draw(st.integers(min_steps, max_steps))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    terminated, truncated = np.zeros((2, steps), dtype=bool)
    if steps:
        draw(st.sampled_from([terminated, truncated]))[-1] = True
    return Trajectory(
        random.normal(size=(steps + 1, 3)).astype(np.float32),
        random.uniform(-1, 1, (steps, 2)).astype(np.float32),
        random.normal(size=steps).astype(np.float32),
        terminated,
        truncated,
        {"success": random.random(steps) < 0.5},
    )
