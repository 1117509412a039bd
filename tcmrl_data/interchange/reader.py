"""The base class of readers, the plug-ins of `tcmrl-data import`, and what they make episodes with.

Files come from strangers. A reader runs no code of theirs, reads no file but those that are named, and
decodes no more than a stated multiple of their size (`decoded_limit`).
"""

import abc
import contextlib
import itertools
import pickle
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from tcmrl_data.envs.base import Split
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import StoreError, TrajectoryError
from tcmrl_data.foundation.files import file_problem, one_line, printable
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.foundation.records import parse_json
from tcmrl_data.store.part import ARRAY_NAME, STANDARD_ARRAYS
from tcmrl_data.store.tables import MAX_INDEX

Array = npt.NDArray[Any]
Say = Callable[[str], None]
"""Takes what a user should know of a file, such as episodes that were cut."""

FORMAT_VERSION = 1
"""Of all layouts that exports write and imports read back."""

EPISODE_ARRAYS = tuple(name for name in STANDARD_ARRAYS if name != "episode_offsets")

FLOOR_BYTES = 4 * 2**20
"""What may be decoded of a file whatever its size."""

LARGEST_RATIO = 4
"""Bytes that may be decoded for each byte of a file; numbers as the field records them seldom reach two."""

DAMAGE = (
    *(OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, EOFError),
    *(OverflowError, MemoryError, SystemError, zlib.error, pickle.UnpicklingError),
)
"""What h5py, pyarrow and pickle raise for damaged files."""


class ReaderOptions(BaseModel):
    """Options of a reader, `--option NAME=VALUE` on the command line; readers add their own fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class ObservationOptions(ReaderOptions):
    """Options of readers whose files may hold observations in several arrays.

    Attributes:
        observation_keys: names of the arrays that are put side by side, separated by commas; all that are
            rows of numbers, sorted by name, where unset.
    """

    observation_keys: str | None = None

    def keys(self) -> tuple[str, ...] | None:
        """The names, in order; None where unset."""
        return None if self.observation_keys is None else tuple(self.observation_keys.split(","))


@dataclass(frozen=True)
class FileTask:
    """What a file says of a task: None, or no parameters, where it does not say."""

    index: int | None = None
    split: Split | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ReadPart:
    """Episodes that become one part.

    Attributes:
        step: snapshot step; 0 where the file does not say.
        trajectories: at least one; every episode ends with a flag, and no flag is set before.
    """

    task: FileTask
    step: int
    trajectories: Sequence[Trajectory]


class Reader(abc.ABC):
    """Reads datasets of one format; a plug-in of the entry point group `tcmrl.readers`.

    Optional libraries are imported inside methods, so that other formats work without them.
    """

    name: ClassVar[str]
    optional_packages: ClassVar[tuple[str, ...]] = ()
    """Modules that the methods import and that an installation without extras lacks."""
    extra: ClassVar[str | None] = None
    """The extra that brings them, such as `tcmrl[parquet]`."""
    Options: ClassVar[type[ReaderOptions]] = ReaderOptions

    def __init__(self, options: ReaderOptions | None = None) -> None:
        self.options = self.Options() if options is None else options

    def files(self, path: Path) -> list[Path]:
        """The files that will be read for a path of the command line, sorted; here, the path is the file.

        Raises:
            StoreError: there is nothing of this format at the path.
        """
        return [require_file(path)]

    @abc.abstractmethod
    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        """Yields the parts of a path, one in memory at a time, in the same order every time.

        Args:
            path: a file or folder, whichever the format has.
            say: told once per file what was left out or cut.

        Raises:
            StoreError: the file is damaged, of another format, or too large for its size on disk; the message
                names the file and the member.
        """


READERS = Registry("tcmrl.readers", "import format", Reader)


def decoded_limit(file_bytes: int) -> int:
    """Bytes that may be decoded of a file of this size."""
    return FLOOR_BYTES + LARGEST_RATIO * file_bytes


def require_file(path: Path) -> Path:
    """The regular file that a path names or leads to.

    Raises:
        StoreError: it is missing or no regular file.
    """
    shown = printable(str(path))
    try:
        resolved = path.resolve(strict=True)
        problem = file_problem(resolved.stat())
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{shown} cannot be read ({one_line(error)}); name a file that can") from None
    if problem is not None:
        raise StoreError(f"{shown} {problem}; name a file")
    return resolved


@contextlib.contextmanager
def damage_at(place: str) -> Iterator[None]:
    """Turns what libraries raise for damaged files into an error that begins with a place.

    Raises:
        StoreError: instead of any of `DAMAGE`.
    """
    try:
        yield
    except DAMAGE as error:
        raise StoreError(f"{place} {one_line(error) or type(error).__name__}") from None


TASK_ATTRIBUTES = ("format_version", "task", "split", "parameters")
"""What `described_task` reads of the attributes that exports write."""


def described_task(attributes: Any, *, place: str) -> FileTask:
    """The task that an exported file names.

    Args:
        attributes: numbers and texts by name, or JSON text of them.
        place: the file, for error messages.

    Raises:
        StoreError: the file is of another version, or the attributes describe no task.
    """
    try:
        found = parse_json(attributes.encode()) if isinstance(attributes, str) else attributes
        version, index, split, text = (found[name] for name in TASK_ATTRIBUTES)
        parameters: Any = parse_json(text.encode())
    except (ValueError, KeyError, TypeError, AttributeError):
        raise StoreError(f"{place}: its attributes do not describe a task") from None
    if version != FORMAT_VERSION:
        raise StoreError(
            f"{place}: format_version {repr(version)[:40]} is not {FORMAT_VERSION}, which is read here"
        )
    if not isinstance(parameters, dict) or split not in ("train", "test"):
        raise StoreError(f"{place}: parameters and split are not those of a task")
    return FileTask(checked_index(index, f"{place}: task"), split, parameters)


def checked_index(value: Any, place: str) -> int:
    """A value, if it is the index of a task or the step of a snapshot.

    Raises:
        StoreError: it is not.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < MAX_INDEX:
        raise StoreError(f"{place} is {repr(value)[:40]}, not an index")
    return value


@dataclass
class EpisodeCuts:
    """Counts what was cut of a file's episodes.

    Attributes:
        broken: episodes that end where the next observation is not that of the next row.
        shortened: episodes whose last step was left out, since the file has no observation after it.
        unflagged: episodes that end without a flag and were marked as truncated.
    """

    broken: int = 0
    shortened: int = 0
    unflagged: int = 0

    def tell(self, say: Say | None, path: Path) -> None:
        """Says what a user should know, if anything was cut."""
        for number, text in (
            (self.broken, "episodes end where next_observations are not the next row's observations"),
            (self.shortened, "episodes lose their last step, whose next observation the file does not have"),
            (self.unflagged, "episodes end without a flag and are marked as truncated, not terminated"),
        ):
            if say is not None and number:
                say(f"{path.name}: {number:,} {text}")


def episodes_of_rows(
    arrays: Mapping[str, Array | None], *, cuts: EpisodeCuts, place: str
) -> list[Trajectory]:
    """The episodes of rows of steps that lie behind one another.

    An episode ends after a row with a flag, after the last row, and where the next observation is not the
    observation of the next row. Without `next_observations`, nobody knows what follows the last row of an
    episode, so that its step is left out.

    Args:
        arrays: by D4RL's names. `observations` (N, observation_dim), `actions` (N, action_dim), `rewards`
            (N,) or (N, 1); where the file has them, `terminals` and `timeouts` (N,), nonzero where the task
            or a time limit ended the episode, and `next_observations`.
        cuts: counts what is cut.
        place: file and member, for error messages.

    Raises:
        StoreError: arrays of other shapes, or values that are no finite float32.
    """
    present = {name: array for name, array in arrays.items() if array is not None}
    observations, actions, rewards = (present[name] for name in ("observations", "actions", "rewards"))
    following, rows = present.get("next_observations"), len(observations)
    for name, array in present.items():
        if len(array) != rows:
            raise StoreError(f"{place}: {name} has {len(array)} rows, observations have {rows}")
    if rows == 0:
        raise StoreError(f"{place}: holds no steps")
    terminated, truncated = (
        _flags(present.get(name, np.zeros(rows, dtype=bool)), f"{place}: {name}")
        for name in ("terminals", "timeouts")
    )
    ends = terminated | truncated
    if following is not None:
        if following.shape != observations.shape:
            raise StoreError(
                f"{place}: next_observations have shape {following.shape}, observations {observations.shape}"
            )
        breaks = (following[:-1] != observations[1:]).reshape(rows - 1, -1).any(axis=1) & ~ends[:-1]
        cuts.broken += int(breaks.sum())
        ends[:-1] |= breaks
    ends[-1] = True
    trajectories = []
    start = 0
    for end in np.flatnonzero(ends).tolist():
        if following is None:
            seen, stop = observations[start : end + 1], end
            cuts.shortened += 1
        else:
            seen, stop = np.concatenate([observations[start : end + 1], following[end : end + 1]]), end + 1
        if stop > start:
            step = slice(start, stop)
            last = (bool(terminated[stop - 1]), bool(truncated[stop - 1]))
            trajectories.append(
                episode_of(seen, actions[step], rewards[step], ended=last, cuts=cuts, place=place)
            )
        start = end + 1
    if not trajectories:
        raise StoreError(f"{place}: holds no whole step")
    return trajectories


def episode_of(
    observations: Array,
    actions: Array,
    rewards: Array,
    *,
    ended: tuple[bool, bool],
    extras: Mapping[str, Array] | None = None,
    cuts: EpisodeCuts,
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
    if steps == 0:
        raise StoreError(f"{place}: holds an episode without steps")
    if not any(ended):
        cuts.unflagged += 1
        ended = (False, True)
    terminated, truncated = np.zeros((2, steps), dtype=bool)
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


def stored_episode(arrays: Mapping[str, Array], *, cuts: EpisodeCuts, place: str) -> Trajectory:
    """The episode of a file that keeps every episode apart, with the flags of every step.

    Args:
        arrays: by the names of `Trajectory`; with `next_observations`, both have a row for each step. Further
            arrays of numbers of (T,) become the episode's own: floats as float32, integers as int64. They are
            left out where a value is not finite, or a part cannot have their names.
        cuts: counts an episode without a flag.
        place: file and member, for error messages.

    Raises:
        StoreError: an array is missing, a flag is set before the last step, a row does not begin where the
            one before it ends, or the errors of `episode_of`.
    """
    for name in EPISODE_ARRAYS:
        if name not in arrays:
            raise StoreError(f"{place}/{name} is missing")
    observations, following = arrays["observations"], arrays.get("next_observations")
    if following is not None:
        observations = _joined(observations, following, place)
    ended = []
    for name in ("terminated", "truncated"):
        flags = _flags(arrays[name], f"{place}: {name}")
        if flags[:-1].any():
            raise StoreError(f"{place}: {name} is set before the episode's last step")
        ended.append(bool(flags[-1:].any()))
    further = {name: array for name, array in arrays.items() if name not in STANDARD_ARRAYS}
    return episode_of(
        observations,
        arrays["actions"],
        arrays["rewards"],
        ended=(ended[0], ended[1]),
        extras={name: kept for name, array in further.items() if (kept := _extra(name, array)) is not None},
        cuts=cuts,
        place=place,
    )


def parts_of_task(
    episodes: Iterable[tuple[int, Trajectory]], task: FileTask, *, place: str
) -> Iterator[ReadPart]:
    """The parts of a task, one for each snapshot step.

    Args:
        episodes: steps and episodes, in the order of the file; those of a step stand behind one another.
        task: what the file says of it.
        place: the file, for error messages.

    Raises:
        StoreError: there is no episode, or a step comes back after another one.
    """
    done: set[int] = set()
    for step, group in itertools.groupby(episodes, key=lambda pair: pair[0]):
        if step in done:
            raise StoreError(f"{place}: the episodes of step {step} do not stand behind one another")
        done.add(step)
        yield ReadPart(task, step, [trajectory for _, trajectory in group])
    if not done:
        raise StoreError(f"{place}: holds no episode")


def _joined(observations: Array, following: Array, place: str) -> Array:
    """(T + 1, observation_dim) from the observations before and after every step."""
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


def _extra(name: str, values: Array) -> Array | None:
    """A further array as a part may have it; None where it may not."""
    if values.ndim != 1 or values.dtype.kind not in "biuf" or not re.fullmatch(ARRAY_NAME, name):
        return None
    with np.errstate(over="ignore"):
        made: Array = values.astype({"b": np.bool_, "f": np.float32}.get(values.dtype.kind, np.int64))
    return made if np.isfinite(made).all() else None


def _flags(values: Array, place: str) -> npt.NDArray[np.bool_]:
    rows = len(values)
    if values.shape not in ((rows,), (rows, 1)):
        raise StoreError(f"{place}: has shape {values.shape}, expected ({rows},)")
    return np.asarray(values.reshape(rows) != 0, dtype=np.bool_)


def _floats(values: Array, place: str) -> npt.NDArray[np.float32]:
    with np.errstate(over="ignore", invalid="ignore"):
        made = np.ascontiguousarray(values, dtype=np.float32)
    if not np.isfinite(made).all():
        raise StoreError(f"{place} hold a value that is not finite as float32")
    return made
