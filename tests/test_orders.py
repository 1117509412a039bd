"""Random orders of episodes that are read from both ends."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tcmrl_data.sampling.draws import fill_places, places_filled, read_end


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
