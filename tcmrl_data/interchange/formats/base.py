"""Base class of export formats, which write a dataset for another library."""

import abc
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import ClassVar

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.store.keys import PartKey

ExportProgress = Callable[[int, int], None]
"""Called with the number of parts written and of all parts."""


def no_progress(done: int, total: int) -> None:
    """Ignores the progress of an export."""


class Format(abc.ABC):
    """Writes datasets task by task; a plug-in of the group `tcmrl.formats`, made without arguments.

    `export_dataset` calls the methods. It stages, syncs and publishes what they write, so that an export
    appears whole or not at all, and a stopped one goes on behind its last finished task. Libraries are
    imported inside methods, so that other formats work without them.
    """

    name: ClassVar[str]
    optional_packages: ClassVar[tuple[str, ...]] = ()
    """Modules that the methods import and that an installation without extras lacks."""
    extra: ClassVar[str | None] = None
    """The extra that brings them, such as `tcmrl[minari]`."""

    @abc.abstractmethod
    def place(self, selection: Selection, task: Task) -> str:
        """Path of a task's file or folder within the export, such as `task_00000.hdf5`."""

    @abc.abstractmethod
    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        """Writes a task, and yields the key of every part when it is written.

        Args:
            selection: `selection.parts[task.index]` are the parts to write, in that order, one in memory at
                a time.
            task: one of the selection's.
            path: a new path that ends in `place(selection, task)`; its parent exists.

        Raises:
            StoreError: the format cannot hold an episode.
            StorageError: the disk refuses; the message names the file.
        """

    def accompanying(self, selection: Selection) -> Mapping[str, bytes]:
        """Small files beside those of the tasks: path within the export, and content."""
        return {}


FORMATS = Registry("tcmrl.formats", "format", Format)
