"""Base class of readers, which read the datasets of other libraries episode by episode."""

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from tcmrl_data.envs.tasks import Split
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.plugins import Registry

Say = Callable[[str], None]
"""Takes what a user should know of a file, such as episodes that were cut."""


def say_nothing(message: str) -> None:
    """Ignores what a reader says."""


class ReaderOptions(BaseModel):
    """Options of a reader, `--option NAME=VALUE` on the command line; readers add their own fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


@dataclass(frozen=True)
class FileTask:
    """What a file says of a task.

    Attributes:
        split: null where the file does not say.
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

    Libraries are imported inside methods, so that other formats work without them.
    """

    name: ClassVar[str]
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
