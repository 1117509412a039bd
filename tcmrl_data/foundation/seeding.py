"""Keyed seeds: the seed of a random stream depends on its purpose and not on the order of drawing.

And the choice that leaves nothing to chance: `evenly_spread`.
"""

import enum
import hashlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")

NO_TASK = 2**32 - 1
"""The task entry for a stream that belongs to the whole environment."""


class Purpose(enum.IntEnum):
    """Purpose of a random stream. The numbers are part of the data's identity: never change one."""

    SPLIT = 0
    BEHAVIOR = 1
    BEHAVIOR_RESET = 2
    ROLLOUT_RESET = 3
    ROLLOUT_NOISE = 4
    REFERENCE_RESET = 5
    REFERENCE_NOISE = 6
    SAMPLER = 7
    LEARNER = 8
    EVALUATION_RESET = 9
    EVALUATION_NOISE = 10
    EVALUATION_CONTEXT = 11
    BEHAVIOR_ACTION = 12
    BEHAVIOR_UPDATE = 13
    SUBSET = 14
    FOLDS = 15
    EXTENSION_NOISE = 16
    EVALUATION_CANDIDATES = 17
    CONTROL_RESET = 18
    TUNING = 19
    TRANSFER_RESET = 20
    TRANSFER_NOISE = 21
    VISIBILITY = 22
    OPERATION = 23
    """Of operations of other packages."""


def environment_key(environment: str) -> int:
    """The first four bytes of sha256(name) as a big-endian integer; the same in every version."""
    return int.from_bytes(hashlib.sha256(environment.encode()).digest()[:4], "big")


def keyed_sequence(
    root: int, environment: str, task: int, purpose: Purpose, *index: int
) -> np.random.SeedSequence:
    """The seed sequence with the key (environment, task, purpose, *index) under the seed `root`.

    Args:
        root: the seed of the build, the task set or the run; any non-negative integer.
        index: further coordinates, such as (snapshot step, episode).

    Raises:
        ValueError: an entry lies outside [0, 2**32), so that two keys could give the same seed.
    """
    key = (environment_key(environment), task, int(purpose), *index)
    if any(not 0 <= entry < 2**32 for entry in key):
        raise ValueError(f"seed entries must lie in [0, 2**32), got {key}")
    return np.random.SeedSequence(root, spawn_key=key)


def keyed_seed(root: int, environment: str, task: int, purpose: Purpose, *index: int) -> int:
    """One uint32, for libraries that take an integer seed; arguments as for `keyed_sequence`."""
    return int(keyed_sequence(root, environment, task, purpose, *index).generate_state(1)[0])


def keyed_generator(
    root: int, environment: str, task: int, purpose: Purpose, *index: int
) -> np.random.Generator:
    """A NumPy generator; arguments as for `keyed_sequence`."""
    return np.random.default_rng(keyed_sequence(root, environment, task, purpose, *index))


def evenly_spread(items: Sequence[Item], number: int) -> list[Item]:
    """At most `number` items, evenly spread over all, the first and the last among them.

    Example:
        >>> evenly_spread("abcdefghi", 3)
        ['a', 'e', 'i']
    """
    positions = np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int)
    return [items[position] for position in positions]
