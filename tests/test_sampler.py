import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tcmrl_data import (
    Batch,
    BatchRequest,
    Dataset,
    Steps,
    Trajectories,
    Trajectory,
    Transitions,
    Windows,
    open_sampler,
)
from tcmrl_data.foundation.errors import RequestError, SelectionError
from tcmrl_data.sampling.draws import BLOCK
from tcmrl_data.sampling.sampler import Sampler
from tests.sampling import numbered_tasks, sampler_of
from tests.strategies import trajectories

REQUEST = BatchRequest(
    tasks=3,
    kinds={
        "policy": Transitions(50),
        "context": Trajectories((1, 2), returns=True),
        "execution": Trajectories(2, apart_from="context"),
        "windows": Windows(20, length=4),
    },
)


LENGTHS = [[5, 9, 4, 7], [3, 8, 8, 6], [10, 4, 5, 1]]


EQUAL = [[6, 6, 6, 6]] * 3


@pytest.fixture
def sampler() -> Sampler:
    return sampler_of(numbered_tasks(LENGTHS), REQUEST, seed=3)


def leaves(batch: Batch) -> list[torch.Tensor]:
    steps = [batch[name] for name in batch.names()]
    found = [getattr(part, field.name) for part in steps for field in dataclasses.fields(part)]
    return [batch.task_indices, *(tensor for tensor in found if tensor is not None)]


def test_a_batch_is_a_function_of_seed_and_number(sampler: Sampler) -> None:
    later = [sampler.batch(n) for n in (7, 2)]
    again = [sampler.batch(n) for n in (2, 7)]
    for left, right in zip(later, reversed(again), strict=True):
        assert all(torch.equal(a, b) for a, b in zip(leaves(left), leaves(right), strict=True))
    assert not torch.equal(later[0]["policy"].observations, later[1]["policy"].observations)


def test_transitions_are_what_was_stored(sampler: Sampler) -> None:
    for n in range(20):
        steps = sampler.batch(n)["policy"]
        task, episode, t = steps.observations.unbind(-1)
        assert torch.equal(steps.rewards, 100 * task + 10 * episode + t)
        assert torch.equal(steps.next_observations, torch.stack([task, episode, t + 1], -1))
        lengths = torch.tensor(LENGTHS)[task.long(), episode.long()]
        assert (t < lengths).all()
        assert torch.equal(steps.terminated.bool(), (t == lengths - 1) & (episode % 2 == 0))


def test_rows_of_a_batch_belong_to_its_tasks(sampler: Sampler) -> None:
    batch = sampler.batch(0)
    assert sorted(batch.task_indices.tolist()) == [0, 1, 2]
    for steps in (batch["policy"], batch["context"], batch["execution"], batch["windows"]):
        tasks, mask = steps.observations[..., 0].flatten(1), steps.mask.flatten(1)
        assert torch.equal(tasks[mask], batch.task_indices[:, None].expand_as(tasks)[mask].float())


def test_windows_never_cross_an_episode(sampler: Sampler) -> None:
    for n in range(50):
        windows = sampler.batch(n)["windows"].observations
        assert windows.shape == (3, 20, 4, 3)
        assert (windows[..., :2] == windows[..., :1, :2]).all(), "a window holds two episodes"
        assert (windows[..., 1:, 2] - windows[..., :-1, 2] == 1).all(), "a window is not contiguous"
        task, episode, t = windows[..., 3, :].unbind(-1)
        assert (t < torch.tensor(LENGTHS)[task.long(), episode.long()]).all()


def test_execution_is_never_the_context(sampler: Sampler) -> None:
    for n in range(50):
        batch = sampler.batch(n)
        context = batch["context"].observations[:, :, 0, 1]
        execution = batch["execution"].observations[:, :, 0, 1]
        assert not (context[:, :, None] == execution[:, None, :]).any()
        assert (execution[:, 0] != execution[:, 1]).all()


def test_masks_mark_the_episode_and_nothing_else(sampler: Sampler) -> None:
    context: Steps = sampler.batch(1)["context"]
    task, episode, t = context.observations.unbind(-1)
    lengths = torch.tensor(LENGTHS)[task.long(), episode.long()]
    assert context.mask.shape[-1] == 10
    assert torch.equal(context.mask.sum(-1), lengths[..., 0])
    assert torch.equal(t[context.mask], torch.arange(10).expand_as(t)[context.mask].float())


def chi_square(counts: np.typing.NDArray[np.int64]) -> float:
    """Standard deviations by which the chi-square statistic of equal shares exceeds its mean."""
    expected = counts.sum() / counts.size
    freedom = counts.size - 1
    return float((np.square(counts - expected).sum() / expected - freedom) / np.sqrt(2 * freedom))


@pytest.mark.parametrize("lengths", [LENGTHS, EQUAL], ids=["ragged", "equal"])
def test_a_million_draws_are_uniform(lengths: list[list[int]]) -> None:
    """Tasks are uniform; transitions, windows and trajectories are uniform over the valid ones of a task."""
    request = BatchRequest(
        tasks=2,
        kinds={
            "policy": Transitions(1000),
            "context": Trajectories(1),
            "execution": Trajectories(1, apart_from="context"),
            "windows": Windows(1000, length=4),
        },
    )
    sampler = sampler_of(numbered_tasks(lengths), request)
    rows = np.zeros((2, len(sampler._rows.table)), dtype=np.int64)
    tasks, episodes = np.zeros(3, dtype=np.int64), np.zeros(12, dtype=np.int64)
    for n in range(500):
        draw = sampler._draws(n)
        for counts, drawn in zip(rows, (draw.picks["policy"], draw.picks["windows"]), strict=True):
            counts += np.bincount(drawn.ravel(), minlength=len(counts))
        tasks += np.bincount(draw.tasks, minlength=3)
        for name in ("context", "execution"):
            episodes += np.bincount(draw.picks[name].ravel(), minlength=12)
    assert rows.sum() == 2 * 10**6
    assert chi_square(tasks) < 4
    first = 0
    for task, task_lengths in enumerate(lengths):
        stop = first + sum(steps + 1 for steps in task_lengths)
        for counts, steps in zip(rows[:, first:stop], (1, 4), strict=True):
            valid = counts[counts > 0]
            assert len(valid) == sum(max(0, length - steps + 1) for length in task_lengths)
            assert chi_square(valid) < 4
        assert chi_square(episodes[4 * task : 4 * task + 4]) < 4
        first = stop


@given(
    st.lists(st.lists(st.sampled_from([0, 1, 3, 4, 5]), min_size=3, max_size=5), min_size=2, max_size=3),
    st.integers(0, 40),
)
@settings(deadline=None, max_examples=60)
def test_every_length_around_k_is_served_as_stated(lengths: list[list[int]], n: int) -> None:
    """K = 4: episodes of 0, 1, K - 1, K and K + 1 steps."""
    for task_lengths in lengths:
        task_lengths += [1, 5]
    request = BatchRequest(
        tasks=3,
        kinds={
            "policy": Transitions(9),
            "context": Trajectories(1),
            "execution": Trajectories(1, apart_from="context"),
            "windows": Windows(7, length=4),
        },
    )
    sampler = sampler_of(numbered_tasks(lengths), request)
    assert sampler.short_trajectories(4) == sum(
        0 < steps < 4 for task_lengths in lengths for steps in task_lengths
    )
    batch = sampler.batch(n)
    for steps in (batch["policy"], batch["context"], batch["execution"], batch["windows"]):
        task, episode, t = (column[steps.mask] for column in steps.observations.unbind(-1))
        length = torch.tensor([lengths[int(b)][int(e)] for b, e in zip(task, episode, strict=True)])
        assert (t < length).all() and steps.mask.flatten(1).any(1).all()
        following = torch.stack([task, episode, t + 1], -1)
        assert torch.equal(steps.next_observations[steps.mask], following)
        assert torch.equal(steps.rewards[steps.mask], 100 * task + 10 * episode + t)
        assert torch.equal(steps.terminated[steps.mask].bool(), (t == length - 1) & (episode % 2 == 0))
        assert not steps.rewards[~steps.mask].any() and not steps.actions[~steps.mask].any()
    assert batch["context"].mask.sum(-1).min() > 0, "an episode without steps was drawn"


def test_padding_holds_nothing_of_another_episode(sampler: Sampler) -> None:
    context = sampler.batch(0)["context"]
    beyond = ~context.mask
    assert not context.next_observations[beyond].any()
    first_padding = beyond & torch.cat([torch.ones_like(beyond[..., :1]), context.mask[..., :-1]], -1)
    assert not context.observations[beyond & ~first_padding].any()


def test_kept_batches_are_never_overwritten_and_dropped_ones_are_used_again(sampler: Sampler) -> None:
    kept = [sampler.batch(n) for n in range(40)]
    view = sampler.batch(40)["windows"].rewards[1]  # parts of a batch keep it alive too
    before = [[leaf.clone() for leaf in leaves(batch)] for batch in kept], view.clone()
    for n in range(41, 141):
        sampler.batch(n)
    assert all(
        torch.equal(a, b)
        for batch, copies in zip(kept, before[0], strict=True)
        for a, b in zip(leaves(batch), copies, strict=True)
    )
    assert torch.equal(view, before[1])
    del kept, view
    places = {sampler.batch(n)["policy"].observations.data_ptr() for n in range(100)}
    assert len(places) <= 2


def test_tasks_depend_on_seed_and_number_alone(sampler: Sampler) -> None:
    """Two samplers with one seed over the same tasks, read alternately."""
    fewer = BatchRequest(tasks=3, kinds={"policy": Transitions(1)})
    other = sampler_of(numbered_tasks([[9, 2]] * 3), fewer, seed=3)
    for n in (0, 1, 17, 40):
        batch = other.batch(n)
        assert torch.equal(batch.task_indices, sampler.batch(n).task_indices)
        assert batch.names() == ["policy"] and "context" not in batch
        with pytest.raises(RequestError, match=r"no kind 'context' in this batch, which holds \['policy'\]"):
            batch["context"]


def test_streams_of_one_seed_differ(sampler: Sampler) -> None:
    first, second = (sampler_of(numbered_tasks(LENGTHS), REQUEST, seed=3, stream=stream) for stream in (0, 1))
    assert torch.equal(first.batch(5)["windows"].rewards, sampler.batch(5)["windows"].rewards)
    assert not torch.equal(first.batch(5)["windows"].rewards, second.batch(5)["windows"].rewards)


@given(st.integers(0, 10 * BLOCK))
@settings(deadline=None, max_examples=30)
def test_resuming_at_n_gives_the_batches_of_an_uninterrupted_run(n: int) -> None:
    straight, resumed = (sampler_of(numbered_tasks(LENGTHS), REQUEST) for _ in range(2))
    for earlier in range(max(0, n - 3), n):
        straight.batch(earlier)
    for index in range(n, n + 2):
        pairs = zip(leaves(straight.batch(index)), leaves(resumed.batch(index)), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs)


@given(
    st.integers(1, 20),
    st.lists(st.lists(trajectories(min_steps=1), min_size=2, max_size=4), min_size=2, max_size=3),
)
@settings(deadline=None, max_examples=30)
def test_moments_equal_those_of_the_flat_data(chunk_rows: int, episodes: list[list[Trajectory]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tcmrl_data.sampling.rows.CHUNK_ROWS", chunk_rows)
        found = sampler_of(episodes, BatchRequest(tasks=2, kinds={})).moments()
    flat = [episode for task in episodes for episode in task]
    observations = np.concatenate([episode.observations[:-1] for episode in flat]).astype(np.float64)
    deltas = np.concatenate([np.diff(episode.observations, axis=0) for episode in flat]).astype(np.float64)
    np.testing.assert_allclose(found.observation_mean, observations.mean(0), atol=1e-6)
    np.testing.assert_allclose(found.delta_std, np.maximum(deltas.std(0), 1e-6), atol=1e-5)
    assert found.longest_episode == max(len(episode) for episode in flat)


def test_test_tasks_are_refused_for_training(tiny: Dataset) -> None:
    with pytest.raises(SelectionError, match=r"test tasks \[3\]"):
        open_sampler(tiny.select(), REQUEST, seed=0)


def test_one_task_is_not_enough(tiny: Dataset) -> None:
    with pytest.raises(SelectionError, match="at least 2"):
        open_sampler(tiny.select(tasks=[0]), REQUEST, seed=0)


def test_no_task_parameter_is_reachable_from_a_batch(sampler: Sampler) -> None:
    """The in-memory tasks have only an index: a sampler that reads other fields fails here."""
    assert {field.name for field in dataclasses.fields(Batch)} == {"task_indices", "steps"}
    assert set(sampler.batch(0).names()) == set(REQUEST.kinds)
    assert {field.name for field in dataclasses.fields(Steps)} == {
        "observations", "actions", "rewards", "next_observations", "terminated", "mask",
        "returns_to_go", "discounts_to_end", "final_observations", "times",
    }  # fmt: skip
    assert all(isinstance(leaf, torch.Tensor) for leaf in leaves(sampler.batch(0)))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
@pytest.mark.parametrize("share", [0.0, 0.5], ids=["copied", "on the device"])
def test_batches_on_a_device_equal_those_on_the_cpu(
    tiny: Dataset, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tcmrl_data.sampling.gather.DEVICE_SHARE", share)
    selection = tiny.select(split="train")
    left, right = (open_sampler(selection, REQUEST, seed=1, device=name) for name in ("cpu", "cuda"))
    with right.prefetch(0, 20) as batches:
        for n, batch in enumerate(batches):
            pairs = zip(leaves(left.batch(n)), leaves(batch), strict=True)
            assert all(torch.equal(a, b.cpu()) for a, b in pairs)
