"""Base class of readers, which read the datasets of other libraries episode by episode."""

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from tcmrl_data.envs.tasks import Split
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import parse_json
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.store.keys import MAX_INDEX

Say = Callable[[str], None]
"""Takes what a user should know of a file, such as episodes that were cut."""


def say_nothing(message: str) -> None:
    """Ignores what a reader says."""


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
        split: null where the file does not say.
        parameters: empty where the file does not say.
    """

    split: Split | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)


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

    Libraries are imported inside methods, so that other formats work without them.
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
        """The files that will be read for a path of the command line, sorted; none of them is a link.

        Raises:
            StoreError: there is nothing of this format at the path.
        """

    @abc.abstractmethod
    def read(self, path: Path, say: Say = say_nothing) -> Iterator[ReadPart]:
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
