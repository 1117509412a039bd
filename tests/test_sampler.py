import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tcmrl_data import Batch, BatchSizes, Dataset, Steps, Trajectory
from tcmrl_data.errors import SelectionError
from tcmrl_data.sampler import Sampler, distinct
from tests.strategies import trajectories

SIZES = BatchSizes(
    tasks=3,
    transitions=50,
    context_trajectories=(1, 2),
    execution_trajectories=2,
    windows=20,
    window_length=4,
)


class InMemorySelection:
    """Offers a sampler what a selection offers, over trajectories made in the test."""

    def __init__(self, episodes: list[list[Trajectory]]) -> None:
        self._episodes = episodes
        self.dataset = self
        self.folder = Path("memory")
        self.environment = self
        self.name = "memory"
        self.observation_dim = episodes[0][0].observations.shape[1]
        self.action_dim = episodes[0][0].actions.shape[1]
        self.tasks = tuple(type("Task", (), {"index": i})() for i in range(len(episodes)))

    def trajectories(self, task: int) -> list[Trajectory]:
        return self._episodes[task]


def numbered(task: int, episode: int, steps: int) -> Trajectory:
    """Observations that say where they come from: (task, episode, t)."""
    observations = np.array([[task, episode, t] for t in range(steps + 1)], dtype=np.float32)
    truncated = np.arange(1, steps + 1) == steps
    terminated = truncated & (episode % 2 == 0)
    rewards = observations[:-1] @ np.array([100.0, 10.0, 1.0])
    return Trajectory(observations, np.zeros((steps, 1)), rewards, terminated, truncated & ~terminated)


LENGTHS = [[5, 9, 4, 7], [3, 8, 8, 6], [10, 4, 5, 1]]


@pytest.fixture
def sampler() -> Sampler:
    episodes = [
        [numbered(b, e, steps) for e, steps in enumerate(lengths)] for b, lengths in enumerate(LENGTHS)
    ]
    return Sampler(InMemorySelection(episodes), SIZES, seed=3)  # type: ignore[arg-type]


def leaves(batch: Batch) -> list[torch.Tensor]:
    steps = [getattr(batch, field) for field in ("transitions", "context", "execution", "windows")]
    return [batch.task_indices, *(getattr(s, f.name) for s in steps for f in dataclasses.fields(s))]


def test_a_batch_is_a_function_of_seed_and_number(sampler: Sampler) -> None:
    later = [sampler.batch(n) for n in (7, 2)]
    again = [sampler.batch(n) for n in (2, 7)]
    for left, right in zip(later, reversed(again), strict=True):
        assert all(torch.equal(a, b) for a, b in zip(leaves(left), leaves(right), strict=True))
    assert not torch.equal(later[0].transitions.observations, later[1].transitions.observations)


def test_transitions_are_what_was_stored(sampler: Sampler) -> None:
    for n in range(20):
        steps = sampler.batch(n).transitions
        task, episode, t = steps.observations.unbind(-1)
        assert torch.equal(steps.rewards, 100 * task + 10 * episode + t)
        assert torch.equal(steps.next_observations, torch.stack([task, episode, t + 1], -1))
        lengths = torch.tensor(LENGTHS)[task.long(), episode.long()]
        assert (t < lengths).all()
        assert torch.equal(steps.terminated.bool(), (t == lengths - 1) & (episode % 2 == 0))


def test_rows_of_a_batch_belong_to_its_tasks(sampler: Sampler) -> None:
    batch = sampler.batch(0)
    assert sorted(batch.task_indices.tolist()) == [0, 1, 2]
    for steps in (batch.transitions, batch.context, batch.execution, batch.windows):
        tasks = steps.observations[..., 0].flatten(1)
        assert torch.equal(tasks, batch.task_indices[:, None].expand_as(tasks).float())


def test_windows_never_cross_an_episode(sampler: Sampler) -> None:
    for n in range(50):
        windows = sampler.batch(n).windows.observations
        assert windows.shape == (3, 20, 4, 3)
        assert (windows[..., :2] == windows[..., :1, :2]).all(), "a window holds two episodes"
        assert (windows[..., 1:, 2] - windows[..., :-1, 2] == 1).all(), "a window is not contiguous"
        task, episode, t = windows[..., 3, :].unbind(-1)
        assert (t < torch.tensor(LENGTHS)[task.long(), episode.long()]).all()


def test_execution_is_never_the_context(sampler: Sampler) -> None:
    for n in range(50):
        batch = sampler.batch(n)
        context = batch.context.observations[:, :, 0, 1]
        execution = batch.execution.observations[:, :, 0, 1]
        assert not (context[:, :, None] == execution[:, None, :]).any()
        assert (execution[:, 0] != execution[:, 1]).all()


def test_masks_mark_the_episode_and_nothing_else(sampler: Sampler) -> None:
    context: Steps = sampler.batch(1).context
    task, episode, t = context.observations.unbind(-1)
    lengths = torch.tensor(LENGTHS)[task.long(), episode.long()]
    assert context.mask.shape[-1] == 10
    assert torch.equal(context.mask.sum(-1), lengths[..., 0])
    assert torch.equal(t[context.mask], torch.arange(10).expand_as(t)[context.mask].float())


@pytest.mark.parametrize("kind", ["transitions", "windows"])
def test_draws_are_uniform_over_valid_rows(sampler: Sampler, kind: str) -> None:
    counts: dict[tuple[float, ...], int] = {}
    for n in range(400):
        rows = getattr(sampler.batch(n), kind).observations.reshape(
            3, -1, *([4] if kind == "windows" else []), 3
        )
        first = rows[:, :, 0] if kind == "windows" else rows
        for key in map(tuple, first[first[..., 0] == 0].tolist()):
            counts[key] = counts.get(key, 0) + 1
    valid = sum(max(0, steps - (3 if kind == "windows" else 0)) for steps in LENGTHS[0])
    assert len(counts) == valid
    expected = sum(counts.values()) / valid
    chi_square = sum((count - expected) ** 2 / expected for count in counts.values())
    assert chi_square < valid + 4 * np.sqrt(2 * valid)  # mean df, four standard deviations


@given(st.integers(1, 6), st.integers(6, 9), st.integers(0, 1000))
def test_distinct_draws_are_distinct_and_in_range(count: int, size: int, seed: int) -> None:
    ranges = np.array([[10, 10 + size], [50, 50 + size]])
    picks = distinct(np.random.default_rng(seed), ranges, count)
    assert all(len(set(row)) == count for row in picks.tolist())
    assert ((picks >= ranges[:, :1]) & (picks < ranges[:, 1:])).all()


def test_distinct_draws_are_uniform() -> None:
    picks = distinct(np.random.default_rng(0), np.tile([0, 5], (20_000, 1)), 3)
    for column in picks.T:
        assert np.abs(np.bincount(column, minlength=5) / 20_000 - 0.2).max() < 0.015


@given(st.lists(st.lists(trajectories(min_steps=1), min_size=2, max_size=4), min_size=2, max_size=3))
@settings(deadline=None, max_examples=30)
def test_moments_equal_those_of_the_flat_data(episodes: list[list[Trajectory]]) -> None:
    sizes = BatchSizes(transitions=4, window_length=2)
    moments = Sampler(InMemorySelection(episodes), sizes, seed=0).moments()  # type: ignore[arg-type]
    flat = [each for task in episodes for each in task]
    observations = np.concatenate([each.observations[:-1] for each in flat]).astype(np.float64)
    deltas = np.concatenate([np.diff(each.observations, axis=0) for each in flat]).astype(np.float64)
    np.testing.assert_allclose(moments.observation_mean, observations.mean(0), atol=1e-6)
    np.testing.assert_allclose(moments.delta_std, np.maximum(deltas.std(0), 1e-6), atol=1e-5)
    assert moments.longest_episode == max(len(each) for each in flat)


def test_test_tasks_are_refused_for_training(tiny: Dataset) -> None:
    with pytest.raises(SelectionError, match=r"test tasks \[3\]"):
        tiny.select().sampler(BatchSizes(), seed=0)


def test_one_task_is_not_enough(tiny: Dataset) -> None:
    with pytest.raises(SelectionError, match="at least 2"):
        tiny.select(tasks=[0]).sampler(BatchSizes(), seed=0)


def test_too_few_trajectories_are_named(tiny: Dataset) -> None:
    sizes = BatchSizes(context_trajectories=(30,))
    with pytest.raises(SelectionError, match=r"task 0 has 18 selected trajectories, a batch takes 31"):
        tiny.select(split="train").sampler(sizes, seed=0)


def test_no_task_parameter_is_reachable_from_a_batch(sampler: Sampler) -> None:
    """The in-memory tasks have an index and nothing else: a sampler that asks for more fails here."""
    assert {field.name for field in dataclasses.fields(Batch)} == {
        "task_indices", "transitions", "context", "execution", "windows",
    }  # fmt: skip
    assert {field.name for field in dataclasses.fields(Steps)} == {
        "observations", "actions", "rewards", "next_observations", "terminated", "mask",
    }  # fmt: skip
    batch = sampler.batch(0)
    assert all(isinstance(leaf, torch.Tensor) for leaf in leaves(batch))
    reachable = [value for value in vars(sampler).values() if isinstance(value, tuple | list | dict)]
    assert not any(hasattr(each, "parameters") for value in reachable for each in value)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
def test_batches_on_a_device_equal_those_on_the_cpu(tiny: Dataset) -> None:
    selection = tiny.select(split="train")
    left, right = (selection.sampler(SIZES, seed=1, device=name).batch(5) for name in ("cpu", "cuda"))
    assert all(torch.equal(a, b.cpu()) for a, b in zip(leaves(left), leaves(right), strict=True))
