"""Base class of export formats, which write a dataset for another library."""

import abc
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.plugins import Registry

ExportProgress = Callable[[int, int], None]
"""Called with the number of parts written and of all parts."""


def no_progress(done: int, total: int) -> None:
    """Ignores the progress of an export."""


class Format(abc.ABC):
    """Writes datasets; a plug-in of the entry point group `tcmrl.formats`, made without arguments.

    Libraries are imported inside `export`, so that other formats work without them.
    """

    name: ClassVar[str]
    optional_packages: ClassVar[tuple[str, ...]] = ()
    """Modules that `export` imports and that an installation without extras lacks."""

    @abc.abstractmethod
    def export(
        self,
        dataset: Dataset,
        out: Path,
        *,
        snapshots: str = "all",
        progress: ExportProgress = no_progress,
    ) -> list[Path]:
        """Writes a dataset into a new folder, one part in memory at a time.

        The folder appears under its name when all files are complete, and not at all when something fails.

        Args:
            dataset: a complete dataset.
            out: the folder to create; it may exist if it is empty.
            snapshots: a rule of `Dataset.select`.
            progress: called as parts are written.

        Returns:
            The files.

        Raises:
            SelectionError: the rule cannot be read or leaves nothing of a task, or the dataset is incomplete.
            StoreError: `out` exists and is not empty, or the format cannot hold an episode.
            StorageError: the disk refuses; the message names the file.
            MissingPackageError: an optional package is not installed.
        """


FORMATS = Registry("tcmrl.formats", "format", Format)
