"""The base class of readers, the plug-ins of `tcmrl-data import`, and what they make episodes with.

Files come from strangers. A reader runs no code of theirs, reads no file but those that are named, and
decodes no more than a stated multiple of their size (`decoded_limit`).
"""

import abc
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from tcmrl_data.envs.tasks import Split
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import parse_json
from tcmrl_data.foundation.errors import StoreError, TrajectoryError
from tcmrl_data.foundation.plain_files import file_problem, one_line, printable
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.store.keys import MAX_INDEX
from tcmrl_data.store.part import ARRAY_NAME, STANDARD_ARRAYS

Array = npt.NDArray[Any]

_NAME = re.compile(ARRAY_NAME)

FLOOR_BYTES = 4 * 2**20
"""What may be decoded of a file whatever its size."""

LARGEST_RATIO = 4
"""Bytes that may be decoded for each byte of a file; numbers as the field records them seldom reach two."""

Say = Callable[[str], None]
"""Takes what a user should know of a file, such as episodes that were cut."""


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
    """What a file says of a task.

    Attributes:
        split: None where the file does not say.
        parameters: empty where the file does not say.
    """

    split: Split | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ReadPart:
    """Episodes that become one part.

    Attributes:
        task: index of the task; None where the file does not say.
        step: snapshot step; 0 where the file does not say.
        trajectories: at least one; every episode ends with a flag, and no flag is set before.
        about: what the file says of the task.
    """

    task: int | None
    step: int
    trajectories: Sequence[Trajectory]
    about: FileTask = field(default_factory=FileTask)


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

    @abc.abstractmethod
    def files(self, path: Path) -> list[Path]:
        """The files that will be read for a path of the command line, sorted.

        Raises:
            StoreError: there is nothing of this format at the path.
        """

    @abc.abstractmethod
    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        """Yields the parts of a path, one in memory at a time, in the same order every time.

        What the file does not say stays open: `ReadPart` says how.

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
    try:
        resolved = path.resolve(strict=True)
        problem = file_problem(resolved.stat())
    except (OSError, RuntimeError) as error:
        shown = printable(str(path))
        raise StoreError(f"{shown} cannot be read ({one_line(error)}); name a file that can") from None
    if problem is not None:
        raise StoreError(f"{printable(str(path))} {problem}; name a file")
    return resolved


TASK_ATTRIBUTES = ("format_version", "task", "split", "parameters")
"""What `described_task` reads of the attributes that exports write."""


def described_task(attributes: Any, *, version: int, place: str) -> tuple[int, FileTask]:
    """Index and description of the task that an exported file names.

    Args:
        attributes: numbers and texts by name, or JSON text of them.
        version: of the format, which is read here.
        place: the file, for error messages.

    Raises:
        StoreError: the file is of another version, or the attributes describe no task.
    """
    try:
        found = parse_json(attributes.encode()) if isinstance(attributes, str) else attributes
        written, index, split, text = (found[name] for name in TASK_ATTRIBUTES)
        parameters: Any = parse_json(text.encode())
    except (ValueError, KeyError, TypeError, AttributeError):
        raise StoreError(f"{place}: its attributes do not describe a task") from None
    if written != version:
        raise StoreError(f"{place}: format_version {repr(written)[:40]} is not {version}, which is read here")
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < MAX_INDEX:
        raise StoreError(f"{place}: task is {repr(index)[:40]}, not an index")
    if not isinstance(parameters, dict) or split not in ("train", "test"):
        raise StoreError(f"{place}: parameters and split are not those of a task")
    return index, FileTask("test" if split == "test" else "train", parameters)


@dataclass
class EpisodeCuts:
    """What was cut of a file's episodes.

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
    *,
    observations: Array,
    actions: Array,
    rewards: Array,
    terminals: Array,
    timeouts: Array | None,
    next_observations: Array | None,
    cuts: EpisodeCuts,
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


def last_flags(terminated: Array, truncated: Array, place: str) -> tuple[bool, bool]:
    """The flags of an episode's last step.

    Raises:
        StoreError: a flag is set before the last step.
    """
    found = []
    for name, flags in (("terminated", terminated), ("truncated", truncated)):
        values = _flags(flags, len(flags), f"{place}: {name}")
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


def parts_of_task(
    episodes: Iterable[tuple[int, Trajectory]], task: int | None, about: FileTask, *, place: str
) -> Iterator[ReadPart]:
    """The parts of a task, one for each snapshot step.

    Args:
        episodes: steps and episodes, in the order of the file; those of a step stand behind one another.
        task: index of the task.
        about: what the file says of it.
        place: the file, for error messages.

    Raises:
        StoreError: there is no episode, or a step comes back after another one.
    """
    done: set[int] = set()
    for step, group in itertools.groupby(episodes, key=lambda pair: pair[0]):
        if step in done:
            raise StoreError(f"{place}: the episodes of step {step} do not stand behind one another")
        done.add(step)
        yield ReadPart(task, step, [trajectory for _, trajectory in group], about)
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
