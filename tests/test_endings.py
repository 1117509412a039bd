"""Returns to go, discounts, last observations and times of drawn steps."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from tcmrl_data import (
    BatchRequest,
    Dataset,
    Steps,
    Trajectories,
    Trajectory,
    Transitions,
    Windows,
    open_sampler,
)
from tests.sampling import sampler_of

KINDS = {
    "policy": Transitions(40, returns=True),
    "context": Trajectories((2, 3), returns=True),
    "windows": Windows(30, length=2, returns=True),
}
REQUEST = BatchRequest(tasks=2, kinds=KINDS, gamma=0.5)
FIELDS = ("returns_to_go", "discounts_to_end", "final_observations", "times")


def episode(number: int, rewards: Sequence[float], *, is_terminated: bool) -> Trajectory:
    """Observations are (number, t); the last step is terminated or truncated."""
    steps = len(rewards)
    ended = np.arange(1, steps + 1) == steps
    observations = np.array([[number, t] for t in range(steps + 1)], dtype=np.float32)
    terminated, truncated = ended & is_terminated, ended & (not is_terminated)
    return Trajectory(observations, np.zeros((steps, 1)), np.array(rewards), terminated, truncated)


RAGGED = [
    episode(0, [1, 2, 4], is_terminated=True),
    episode(1, [8], is_terminated=False),
    episode(2, [], is_terminated=True),
    episode(3, [-2, 6], is_terminated=False),
    episode(4, [2, 0, 8], is_terminated=False),
    episode(5, [3], is_terminated=True),
]
RETURNS = {0: [3, 4, 4], 1: [8], 3: [1, 6], 4: [4, 4, 8], 5: [3]}
"""By hand, gamma = 1/2: 1 + 4/2, 2 + 4/2, 4; 8; -2 + 6/2, 6; 2 + 4/2, 0 + 8/2, 8; 3."""

DISCOUNTS = {0: [0, 0, 0], 1: [0.5], 3: [0.25, 0.5], 4: [0.125, 0.25, 0.5], 5: [0]}
"""0 where the task ended the episode."""


def check(steps: Steps) -> None:
    """Checks all four arrays of drawn steps against the tables above, and zeros on padding."""
    returns, discounts, final, times = (getattr(steps, name) for name in FIELDS)
    assert returns.dtype == discounts.dtype == final.dtype == torch.float32 and times.dtype == torch.int64
    assert returns.shape == discounts.shape == times.shape == steps.rewards.shape
    assert final.shape == steps.observations.shape
    seen = steps.observations[steps.mask].long().tolist()
    lengths = [len(RETURNS[number]) for number, _ in seen]
    assert times[steps.mask].tolist() == [t for _, t in seen]
    assert returns[steps.mask].tolist() == [RETURNS[number][t] for number, t in seen]
    assert discounts[steps.mask].tolist() == [DISCOUNTS[number][t] for number, t in seen]
    assert final[steps.mask].tolist() == [
        [number, length] for (number, _), length in zip(seen, lengths, strict=True)
    ]
    assert not any(values[~steps.mask].any() for values in (returns, discounts, final, times))


@pytest.mark.parametrize("chunk_rows", [1, 2, 5, 7, 2**16])
def test_endings_of_ragged_episodes_are_those_computed_by_hand(
    chunk_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Episodes of 0, 1, 2 and 3 steps, terminated and truncated, in chunks of any size."""
    monkeypatch.setattr("tcmrl_data.sampling.gather.CHUNK_ROWS", chunk_rows)
    sampler = sampler_of([RAGGED] * 2, REQUEST)
    drawn = set()
    for n in range(10):
        batch = sampler.batch(n)
        for name in KINDS:
            check(batch[name])
        assert not batch["context"].mask.all(), "no padding was tried"
        drawn |= set(batch["policy"].observations[..., 0].flatten().tolist())
    assert drawn == set(RETURNS)


def test_only_kinds_that_want_endings_have_them() -> None:
    kinds = {"policy": Transitions(4), "inner": Transitions(4, returns=True)}
    batch = sampler_of([RAGGED] * 2, BatchRequest(tasks=2, kinds=kinds)).batch(0)
    assert all(getattr(batch["policy"], name) is None for name in FIELDS)
    assert all(getattr(batch["inner"], name) is not None for name in FIELDS)


def test_endings_from_the_cache_are_those_from_memory(
    tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path))
    selection = tiny.select(split="train", snapshots="last")
    request = BatchRequest(tasks=3, kinds=KINDS, gamma=0.9)
    mapped = open_sampler(selection, request, seed=0, memory_limit=1)
    assert isinstance(mapped._rows.table, np.memmap)
    left, right = open_sampler(selection, request, seed=0).batch(2), mapped.batch(2)
    for name in KINDS:
        for field in FIELDS:
            assert torch.equal(getattr(left[name], field), getattr(right[name], field)), (name, field)
    stored = {
        float(trajectory.rewards[0]): trajectory
        for trajectory in selection.trajectories(int(left.task_indices[0]))
    }
    context = left["context"]
    assert context.returns_to_go is not None
    for rewards, returns in zip(context.rewards[0], context.returns_to_go[0], strict=True):
        own = stored[rewards[0].item()].rewards.astype(np.float64)
        assert returns[0].item() == pytest.approx(own @ 0.9 ** np.arange(len(own)), rel=1e-5)
