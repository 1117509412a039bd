"""A choice of evenly spread items."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def evenly(items: Sequence[Item], count: int) -> tuple[Item, ...]:
    """At most `count` items, evenly spread, with the first and the last."""
    places = np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))
    return tuple(items[place] for place in places)
