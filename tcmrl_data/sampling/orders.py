"""Random orders (permutations) of a task's episodes, of which only both ends are computed.

The places of an order are filled from the outside in: first, last, second, second to last, and so on. The
episode at a place is uniform over the episodes not yet placed, so all orders are equally likely, and it
depends only on the random numbers of this place and of the places filled before. Two kinds that read one
order from its two ends share no episode, and the number of one kind does not change the draws of the other.
"""

import numpy as np
import numpy.typing as npt

from tcmrl_data.sampling.rows import Indices

Uniform = npt.NDArray[np.float64]


def places_filled(number: int, *, from_back: bool) -> int:
    """The number of places to fill in order to read `number` episodes from one end."""
    return max(0, 2 * number - 1 + from_back)


def fill_places(counts: Indices, uniform: Uniform) -> Indices:
    """Fills the outer places of orders.

    Args:
        counts: (...) number of episodes of every order.
        uniform: (places, ...) uniform random numbers in [0, 1).

    Returns:
        (places, ...) episodes in the sequence in which places are filled; entry k is not defined if k is
        not below an order's count.
    """
    places = len(uniform)
    found = np.empty(uniform.shape, dtype=np.int64)
    taken = np.full((places + 1, *counts.shape), np.iinfo(np.int64).max)  # ascending
    before = np.arange(places).reshape(places, *[1] * counts.ndim)
    for k in range(places):
        pick = below(uniform[k], np.maximum(counts - k, 1))
        if k:  # skip every taken episode that has at most `pick` free episodes before it
            pick += (taken[:k] - before[:k] <= pick).sum(axis=0)
        found[k] = pick
        taken[1 : k + 1] = np.minimum(np.maximum(taken[:k], pick), taken[1 : k + 1])
        taken[0] = np.minimum(taken[0], pick)
    return found


def read_end(filled: Indices, counts: Indices, number: int, *, from_back: bool) -> Indices:
    """Reads episodes (..., number) from one end of every order, the outermost episode first.

    Args:
        filled: the result of `fill_places`, with at least `places_filled(number)` places or with all places.
        counts: (...) number of episodes of every order, at least `number`.
        number: number of episodes to read.
        from_back: reads from the back if True, from the front otherwise.
    """
    inwards = np.arange(number).reshape(number, *[1] * counts.ndim)
    place = 2 * inwards + from_back
    from_other_end = 2 * (counts - 1 - inwards) + (not from_back)
    index = np.where(place < counts, place, from_other_end)
    return np.ascontiguousarray(np.moveaxis(np.take_along_axis(filled, index, axis=0), 0, -1))


def below(uniform: Uniform, counts: Indices | int) -> Indices:
    """Random integers in [0, counts); a float below 1 times a count never rounds up to the count."""
    result: Indices = (uniform * counts).astype(np.int64)
    return result
