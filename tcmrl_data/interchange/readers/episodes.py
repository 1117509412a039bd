"""Episodes from rows as other libraries store them."""

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError, TrajectoryError
from tcmrl_data.store.part import ARRAY_NAME, STANDARD_ARRAYS

Array = npt.NDArray[Any]

_NAME = re.compile(ARRAY_NAME)


@dataclass
class Cuts:
    """What was cut of a file's episodes.

    Attributes:
        broken: episodes that end where the next observation is not that of the next row.
        shortened: episodes whose last step was left out, since the file has no observation after it.
        unflagged: episodes that end without a flag and were marked as truncated.
    """

    broken: int = 0
    shortened: int = 0
    unflagged: int = 0

    def sentences(self) -> list[str]:
        """What a user should know; empty where nothing was cut."""
        found = (
            (self.broken, "episodes end where next_observations are not the next row's observations"),
            (self.shortened, "episodes lose their last step, whose next observation the file does not have"),
            (self.unflagged, "episodes end without a flag and are marked as truncated, not terminated"),
        )
        return [f"{number:,} {text}" for number, text in found if number]


def episodes_of_rows(
    *,
    observations: Array,
    actions: Array,
    rewards: Array,
    terminals: Array,
    timeouts: Array | None,
    next_observations: Array | None,
    cuts: Cuts,
    place: str,
) -> list[Trajectory]:
    """The episodes of rows of steps that lie behind one another.

    An episode ends after a row with a flag, after the last row, and where the next observation is not the
    observation of the next row. Without `next_observations`, nobody knows what follows the last row of an
    episode, so that its step is left out.

    Args:
        observations: (N, observation_dim).
        actions: (N, action_dim).
        rewards: (N,) or (N, 1).
        terminals: (N,), nonzero where the task ended the episode.
        timeouts: (N,), nonzero where a time limit did; None where the file does not say.
        next_observations: (N, observation_dim).
        cuts: counts what is cut.
        place: file and member, for error messages.

    Raises:
        StoreError: arrays of other shapes, or values that are no finite float32.
    """
    rows = len(observations)
    arrays = {"actions": actions, "rewards": rewards, "terminals": terminals, "timeouts": timeouts}
    arrays |= {"next_observations": next_observations}
    for name, array in arrays.items():
        if array is not None and len(array) != rows:
            raise StoreError(f"{place}: {name} has {len(array)} rows, observations have {rows}")
    if rows == 0:
        raise StoreError(f"{place}: holds no steps")
    terminated = _flags(terminals, rows, f"{place}: terminals")
    truncated = _flags(timeouts, rows, f"{place}: timeouts") if timeouts is not None else np.zeros(rows, bool)
    ends = terminated | truncated
    if next_observations is not None:
        if next_observations.shape != observations.shape:
            raise StoreError(
                f"{place}: next_observations have shape {next_observations.shape}, observations "
                f"{observations.shape}"
            )
        breaks = (next_observations[:-1] != observations[1:]).reshape(rows - 1, -1).any(axis=1) & ~ends[:-1]
        cuts.broken += int(breaks.sum())
        ends[:-1] |= breaks
    ends[-1] = True
    trajectories = []
    start = 0
    for end in np.flatnonzero(ends).tolist():
        stop = end + 1
        if next_observations is None:
            seen, stop = observations[start : end + 1], end
            cuts.shortened += 1
        else:
            seen = np.concatenate([observations[start:stop], next_observations[end : end + 1]])
        if stop > start:
            step = slice(start, stop)
            last = (bool(terminated[stop - 1]), bool(truncated[stop - 1]))
            trajectories.append(
                episode(seen, actions[step], rewards[step], ended=last, cuts=cuts, place=place)
            )
        start = end + 1
    if not trajectories:
        raise StoreError(f"{place}: holds no whole step")
    return trajectories


def episode(
    observations: Array,
    actions: Array,
    rewards: Array,
    *,
    ended: tuple[bool, bool],
    extras: Mapping[str, Array] | None = None,
    cuts: Cuts,
    place: str,
) -> Trajectory:
    """One episode with its flags at the last step.

    Args:
        observations: (T + 1, observation_dim).
        actions: (T, action_dim).
        rewards: (T,) or (T, 1).
        ended: whether the task ended it, and whether a time limit did; where neither did, it is truncated.
        extras: further arrays of (T,).
        cuts: counts what has no flag.
        place: file and member, for error messages.

    Raises:
        StoreError: arrays that form no episode, values that are no finite float32, or actions beyond [-1, 1].
    """
    steps = len(actions)
    terminated, truncated = np.zeros((2, steps), dtype=bool)
    if steps == 0:
        raise StoreError(f"{place}: holds an episode without steps")
    if ended == (False, False):
        cuts.unflagged += 1
        ended = (False, True)
    terminated[-1], truncated[-1] = ended
    if rewards.ndim == 2 and rewards.shape[1] == 1:
        rewards = rewards[:, 0]
    try:
        made = Trajectory(
            _floats(observations, f"{place}: observations"),
            _floats(actions, f"{place}: actions"),
            _floats(rewards, f"{place}: rewards"),
            terminated,
            truncated,
            dict(extras or {}),
        )
    except TrajectoryError as error:
        raise StoreError(f"{place}: {error}") from None
    largest = float(np.abs(made.actions).max(initial=0.0))
    if largest > 1.0:
        raise StoreError(
            f"{place}: actions reach {largest:g}, beyond [-1, 1]; scale them by the bounds of their space "
            "and import the result"
        )
    return made


def joined_observations(observations: Array, following: Array, *, place: str) -> Array:
    """The observations of an episode, (T + 1, observation_dim), from those before and after every step.

    Raises:
        StoreError: other shapes, or a row that does not begin where the row before it ends.
    """
    if observations.ndim != 2 or observations.shape != following.shape or not len(following):
        raise StoreError(
            f"{place}: observations before and after the steps have shapes {observations.shape} and "
            f"{following.shape}"
        )
    if (following[:-1] != observations[1:]).any():
        raise StoreError(
            f"{place}: a row does not begin with the observation in which the row before it ends"
        )
    return np.concatenate([observations, following[-1:]])


def last_flags(terminated: Array, truncated: Array | None, place: str) -> tuple[bool, bool]:
    """The flags of an episode's last step.

    Raises:
        StoreError: a flag is set before the last step.
    """
    found = []
    for name, flags in (("terminated", terminated), ("truncated", truncated)):
        values = np.zeros(1, bool) if flags is None else _flags(flags, len(flags), f"{place}: {name}")
        if values[:-1].any():
            raise StoreError(f"{place}: {name} is set before the episode's last step")
        found.append(bool(values[-1:].any()))
    return found[0], found[1]


def extras_of(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """The further per-step arrays that a part may have: of numbers, of rank 1, with a name of its kind.

    Floats become float32, integers int64; what is not finite as float32 is left out.
    """
    kept = {}
    for name, values in arrays.items():
        kind = values.dtype.kind
        if values.ndim != 1 or kind not in "biuf" or name in STANDARD_ARRAYS or not _NAME.fullmatch(name):
            continue
        with np.errstate(over="ignore"):
            made: Array = values.astype({"b": np.bool_, "f": np.float32}.get(kind, np.int64))
        if np.isfinite(made).all():
            kept[name] = made
    return kept


def parts_by_step(
    episodes: Iterable[tuple[int, Trajectory]], *, place: str
) -> Iterator[tuple[int, list[Trajectory]]]:
    """Episodes of equal snapshot steps together; they must stand behind one another.

    Args:
        episodes: steps and episodes, in the order of the file.
        place: the file, for error messages.

    Raises:
        StoreError: there is no episode, or a step comes back after another one.
    """
    done: set[int] = set()
    for step, group in itertools.groupby(episodes, key=lambda pair: pair[0]):
        if step in done:
            raise StoreError(f"{place}: the episodes of step {step} do not stand behind one another")
        done.add(step)
        yield step, [trajectory for _, trajectory in group]
    if not done:
        raise StoreError(f"{place}: holds no episode")


def _flags(values: Array, rows: int, place: str) -> npt.NDArray[np.bool_]:
    if values.shape not in ((rows,), (rows, 1)):
        raise StoreError(f"{place}: has shape {values.shape}, expected ({rows},)")
    return np.asarray(values.reshape(rows) != 0, dtype=np.bool_)


def _floats(values: Array, place: str) -> npt.NDArray[np.float32]:
    """Numbers as the float32 of a dataset.

    Raises:
        StoreError: a value that is not finite there.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        made = np.ascontiguousarray(values, dtype=np.float32)
    if not np.isfinite(made).all():
        raise StoreError(f"{place} hold a value that is not finite as float32")
    return made
