"""Prefetching batches: order, bound, errors, and the end of the thread."""

import threading

import pytest

from tcmrl_data import BatchRequest, Prefetch, Trajectories, Transitions
from tests.sampling import numbered_tasks, sampler_of
from tests.workers import wait_for


def threads() -> int:
    return sum(thread.name.startswith("prefetch") for thread in threading.enumerate())


@pytest.mark.parametrize("depth", [0, 1, 2, 7])
def test_items_come_in_order_whatever_the_depth(depth: int) -> None:
    with Prefetch(lambda n: n * n, range(3, 40), depth=depth) as items:
        assert list(items) == [n * n for n in range(3, 40)]
        assert items.waited > 0
        with pytest.raises(StopIteration):
            next(items)
    assert threads() == 0


@pytest.mark.parametrize("depth", [0, 1, 3])
def test_batches_are_the_same_whatever_the_depth(depth: int) -> None:
    sampler = sampler_of(
        numbered_tasks([[5, 6, 7]] * 3),
        BatchRequest(tasks=16, kinds={"policy": Transitions(8), "context": Trajectories(1)}),
    )
    with sampler.prefetch(4, 30, depth=depth) as batches:
        for n, batch in zip(range(4, 30), batches, strict=True):
            expected = sampler.batch(n)
            assert batch["policy"].observations.equal(expected["policy"].observations)
            assert batch["context"].rewards.equal(expected["context"].rewards)


def test_no_more_are_made_than_the_depth_and_the_one_at_work() -> None:
    """The requested batches, two in the queue, and one that waits for a place in the queue."""
    asked, ahead = 0, []

    def make(n: int) -> int:
        ahead.append(n + 1 - asked)
        return n

    with Prefetch(make, range(100), depth=2) as items:
        for asked in range(1, 101):
            assert next(items) == asked - 1
            wait_for(lambda: len(ahead) == min(asked + 3, 100), "the thread to go ahead")  # noqa: B023
    assert max(ahead) == 3


@pytest.mark.parametrize("depth", [0, 2])
def test_an_error_comes_where_its_item_would(depth: int) -> None:
    def make(n: int) -> int:
        if n == 3:
            raise ValueError("three")
        return n

    with Prefetch(make, range(10), depth=depth) as items:
        assert [next(items) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(ValueError, match="three"):
            next(items)
    assert threads() == 0


def test_leaving_early_ends_the_thread() -> None:
    with Prefetch(lambda n: n, range(10**9), depth=2) as items:
        next(items)
        assert threads() == 1
    assert threads() == 0
    with pytest.raises(StopIteration):
        next(items)
