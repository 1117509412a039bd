"""Keyed seeds: every random stream is addressed by what it is for, never by the order of drawing."""

import enum
import hashlib

import numpy as np

NO_TASK = 2**32 - 1
"""The task entry of a stream that belongs to a whole environment."""


class Purpose(enum.IntEnum):
    """What a stream is for. Entries are part of the data's identity: add, never renumber."""

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


def environment_key(environment: str) -> int:
    """First four bytes of sha256(name), big-endian: stable over versions, below 2**32."""
    return int.from_bytes(hashlib.sha256(environment.encode()).digest()[:4], "big")


def keyed_sequence(
    root: int, environment: str, task: int, purpose: Purpose, *index: int
) -> np.random.SeedSequence:
    """Seed sequence addressed by (environment, task, purpose, *index) under the seed `root`.

    Args:
        root: the seed of the build, the task set or the run; any non-negative integer.
        environment: the environment's name.
        task: the task's index, or NO_TASK.
        purpose: what the stream is for.
        index: further coordinates, such as (snapshot step, episode).

    Raises:
        ValueError: an entry is negative or not below 2**32, where entries would collide.
    """
    key = (environment_key(environment), task, int(purpose), *index)
    if any(not 0 <= entry < 2**32 for entry in key):
        raise ValueError(f"seed entries must lie in [0, 2**32), got {key}")
    return np.random.SeedSequence(root, spawn_key=key)


def keyed_seed(root: int, environment: str, task: int, purpose: Purpose, *index: int) -> int:
    """One uint32 for libraries that take an integer seed; arguments as for `keyed_sequence`."""
    return int(keyed_sequence(root, environment, task, purpose, *index).generate_state(1)[0])


def keyed_generator(
    root: int, environment: str, task: int, purpose: Purpose, *index: int
) -> np.random.Generator:
    """NumPy generator of the addressed stream; arguments as for `keyed_sequence`."""
    return np.random.default_rng(keyed_sequence(root, environment, task, purpose, *index))
