"""Random orders of a task's episodes, read from both ends without computing their middle.

An order's places are filled from the outside in: first, last, second, last but one, and so on, each with an
episode that is uniform over those not yet placed. Every order is equally likely, and what stands at a place
depends on the random numbers of the places filled before it alone. Two kinds that read one order from its two
ends therefore never meet, and neither's number changes what the other reads.
"""

import numpy as np
import numpy.typing as npt

from tcmrl_data.sampling.rows import Indices

Uniform = npt.NDArray[np.float64]


def places_filled(number: int, *, from_back: bool) -> int:
    """How many places must be filled to read `number` episodes from one end."""
    return max(0, 2 * number - 1 + from_back)


def fill_places(counts: Indices, uniform: Uniform) -> Indices:
    """(places, ...) episodes in the sequence in which places are filled; meaningless beyond `counts`.

    Args:
        counts: (...) episodes of each order.
        uniform: (places, ...) in [0, 1); the k-th picks among what the first k - 1 left.
    """
    places = len(uniform)
    found = np.empty(uniform.shape, dtype=np.int64)
    taken = np.full((places + 1, *counts.shape), np.iinfo(np.int64).max)  # ascending
    before = np.arange(places).reshape(places, *[1] * counts.ndim)
    for k in range(places):
        pick = below(uniform[k], np.maximum(counts - k, 1))
        if k:  # step over every taken episode with at most `pick` free ones before it
            pick += (taken[:k] - before[:k] <= pick).sum(axis=0)
        found[k] = pick
        taken[1 : k + 1] = np.minimum(np.maximum(taken[:k], pick), taken[1 : k + 1])
        taken[0] = np.minimum(taken[0], pick)
    return found


def read_end(filled: Indices, counts: Indices, number: int, *, from_back: bool) -> Indices:
    """(..., number) episodes from one end of every order, the outermost first.

    Args:
        filled: what `fill_places` gave, of at least `places_filled(number)` places or all.
        counts: (...) episodes of each order, at least `number`.
        number: how many to read.
        from_back: which end.
    """
    inwards = np.arange(number).reshape(number, *[1] * counts.ndim)
    place = 2 * inwards + from_back
    from_other_end = 2 * (counts - 1 - inwards) + (not from_back)
    index = np.where(place < counts, place, from_other_end)
    return np.ascontiguousarray(np.moveaxis(np.take_along_axis(filled, index, axis=0), 0, -1))


def below(uniform: Uniform, counts: Indices | int) -> Indices:
    """Integers below the counts; the product of a float below 1 and a count never rounds up to the count."""
    result: Indices = (uniform * counts).astype(np.int64)
    return result
