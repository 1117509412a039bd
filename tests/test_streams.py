"""Draws of a batch: tasks and every kind have their own random streams; orders of episodes."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tcmrl_data import Batch, BatchRequest, Trajectories, Transitions, Windows
from tcmrl_data.foundation.errors import RequestError, SelectionError
from tcmrl_data.sampling.draws import fill_places, places_filled, read_end
from tests.sampling import numbered_tasks, sampler_of

LENGTHS = [[5, 9, 4, 7, 6, 8], [4, 8, 8, 6, 5, 5, 7], [10, 4, 5, 7, 6, 9, 4, 5]]
PLAIN = {
    "policy": Transitions(6),
    "context": Trajectories(2),
    "execution": Trajectories(1, apart_from="context"),
    "windows": Windows(3, length=4),
    "other": Trajectories((1, 3)),
}
LARGER = {
    "policy": Transitions(40, returns=True),
    "context": Trajectories((1, 3), returns=True),
    "execution": Trajectories((2, 3), apart_from="context"),
    "windows": Windows(9, length=3, returns=True),
    "other": Trajectories(4),
}


def batch_of(kinds: dict[str, Any], n: int) -> Batch:
    return sampler_of(numbered_tasks(LENGTHS), BatchRequest(tasks=2, kinds=kinds)).batch(n)


@given(
    st.dictionaries(st.sampled_from(sorted(PLAIN)), st.sampled_from([PLAIN, LARGER])),
    st.permutations(sorted(PLAIN)),
    st.integers(0, 40),
)
@settings(deadline=None, max_examples=100)
def test_no_kind_changes_the_draws_of_another(
    sizes: dict[str, dict[str, Any]], order: list[str], n: int
) -> None:
    """Any combination of kinds, sizes and orders gives the same draws of a kind as the plain request."""
    kinds = {name: sizes[name][name] for name in order if name in sizes}
    if "context" not in kinds:
        kinds.pop("execution", None)  # it needs a partner
    found = batch_of(kinds, n)
    for name, kind in kinds.items():
        expected = batch_of({**PLAIN, name: kind}, n)
        assert torch.equal(found.task_indices, expected.task_indices)
        assert torch.equal(found[name].observations, expected[name].observations), name
        assert torch.equal(found[name].mask, expected[name].mask), name


def test_a_kind_is_keyed_by_its_name() -> None:
    batch = batch_of({"one": Transitions(50), "two": Transitions(50)}, 0)
    assert not torch.equal(batch["one"].observations, batch["two"].observations)
    renamed = batch_of({"two": Transitions(50), "three": Transitions(50)}, 0)
    assert torch.equal(renamed["two"].observations, batch["two"].observations)


@pytest.mark.parametrize("numbers", [(1, 1), (2, 3), (1, 5), (5, 1)], ids=str)
def test_apart_kinds_are_disjoint_and_uniform(numbers: tuple[int, int]) -> None:
    """Chi-square over the 30 ordered pairs of different episodes, the last episodes of both kinds."""
    kinds = {"context": Trajectories(numbers[0]), "execution": Trajectories(numbers[1], apart_from="context")}
    sampler = sampler_of(numbered_tasks([[3] * 6] * 2), BatchRequest(tasks=2, kinds=kinds))
    pairs = np.zeros((6, 6), dtype=np.int64)
    for n in range(6000):
        drawn = sampler._draws(n).picks
        for context, execution in zip(drawn["context"] % 6, drawn["execution"] % 6, strict=True):
            assert len({*context.tolist(), *execution.tolist()}) == sum(numbers)
            pairs[context[-1], execution[-1]] += 1
    different = pairs[~np.eye(6, dtype=bool)]
    assert different.sum() == 12_000
    statistic = (np.square(different - 400) / 400).sum()
    assert statistic < 29 + 4 * np.sqrt(2 * 29)


def test_another_request_of_the_same_rows_draws_as_if_opened_anew() -> None:
    larger = BatchRequest(tasks=2, kinds=LARGER, gamma=0.5)
    first = sampler_of(numbered_tasks(LENGTHS), BatchRequest(tasks=2, kinds=PLAIN))
    later, expected = (
        first.with_request(larger).batch(3),
        sampler_of(numbered_tasks(LENGTHS), larger).batch(3),
    )
    for name in LARGER:
        assert torch.equal(later[name].rewards, expected[name].rewards)
    assert torch.equal(later["policy"].returns_to_go, expected["policy"].returns_to_go)
    assert first.request.kinds == PLAIN and first.batch(0).names() == list(PLAIN)


def test_a_kind_of_number_zero_is_not_requested() -> None:
    kinds = {"policy": Transitions(1), "windows": Windows(0, length=3), "context": Trajectories(0)}
    assert BatchRequest(tasks=2, kinds=kinds).kinds == {"policy": Transitions(1)}


ONE = Trajectories(1)


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        ({"a": Transitions(-1)}, "'a': numbers must be 0 or more"),
        ({"a": Trajectories(())}, "'a': numbers must be 0 or more"),
        ({"a": Windows(1, length=0)}, "'a': a window has at least 1 step"),
        ({"a": replace(ONE, apart_from="b")}, "apart_from='b' names no other kind"),
        ({"a": replace(ONE, apart_from="a")}, "apart_from='a' names no other kind"),
        ({"a": replace(ONE, apart_from="b"), "b": Transitions(1)}, "apart_from='b' names no other kind"),
        ({"a": replace(ONE, apart_from="b"), "b": replace(ONE, apart_from="a")}, "more than two kinds"),
        ({"a": ONE, "b": replace(ONE, apart_from="a"), "c": replace(ONE, apart_from="a")}, "more than two"),
    ],
    ids=range(8),
)
def test_a_request_that_does_not_hold_together_is_refused(kinds: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        BatchRequest(tasks=2, kinds=kinds)


@pytest.mark.parametrize("change", [{"tasks": 0}, {"gamma": 1.01}, {"gamma": -0.1}], ids=str)
def test_numbers_outside_their_range_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(RequestError, match=r"the request says"):
        replace(BatchRequest(tasks=2, kinds={}), **change)


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        ({"context": Trajectories(2)}, "task 1 has 1 selected trajectories, a batch takes 2"),
        ({"windows": Windows(1, length=3)}, "task 1 has 0 selected stretches of 3 steps, a batch takes 1"),
    ],
    ids=["trajectories", "windows"],
)
def test_a_task_that_holds_too_little_is_named(kinds: dict[str, Any], message: str) -> None:
    with pytest.raises(SelectionError, match=message):
        sampler_of(numbered_tasks([[3, 3], [2]]), BatchRequest(tasks=2, kinds=kinds))


@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), st.data())
def test_both_ends_belong_to_one_order_whatever_their_numbers(counts: list[int], data: st.DataObject) -> None:
    """Draws of an end do not repeat, the ends are disjoint, and neither depends on the other's number."""
    front = data.draw(st.integers(0, min(counts)))
    back = data.draw(st.integers(0, min(counts) - front))
    seed = data.draw(st.integers(0, 100))
    sizes = np.array(counts)

    def read(number: int, *, from_back: bool, places: int) -> list[list[int]]:
        uniform = np.random.default_rng(seed).random((places, len(sizes)))
        filled = fill_places(sizes, uniform)
        found: list[list[int]] = read_end(filled, sizes, number, from_back=from_back).tolist()
        return found

    needed = [places_filled(front, from_back=False), places_filled(back, from_back=True)]
    fronts = read(front, from_back=False, places=max(needed))
    backs = read(back, from_back=True, places=max(needed))
    for size, one, other in zip(counts, fronts, backs, strict=True):
        assert len({*one, *other}) == front + back
        assert all(0 <= episode < size for episode in (*one, *other))
    assert fronts == read(front, from_back=False, places=min(needed[0], max(counts)))
    assert backs == read(back, from_back=True, places=min(needed[1], max(counts)))
    whole = read(min(counts), from_back=False, places=2 * max(counts))
    assert [order[:front] for order in whole] == fronts


def test_every_order_is_equally_likely() -> None:
    num_orders = 240_000
    counts = np.full(num_orders, 4)
    filled = fill_places(counts, np.random.default_rng(0).random((4, num_orders)))
    orders = read_end(filled, counts, 4, from_back=False)
    assert (orders == read_end(filled, counts, 4, from_back=True)[:, ::-1]).all()
    found = np.array(list(Counter(map(tuple, orders.tolist())).values()))
    assert len(found) == 24
    statistic = (np.square(found - 10_000) / 10_000).sum()
    assert statistic < 23 + 4 * np.sqrt(2 * 23)
