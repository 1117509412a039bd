"""Checks of one part against its line in the table, and of its archive."""

import os
from collections.abc import Iterator
from pathlib import Path

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.plain_files import file_problem, folder_problem, words_after
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.part_files import check_members, identity_problems
from tcmrl_data.store.part_record import PartRecord, read_part_record
from tcmrl_data.store.part_table import PartEntry
from tcmrl_data.store.task_table import TASKS
from tcmrl_data.verification.contents import content_problems
from tcmrl_data.verification.description import Description
from tcmrl_data.verification.findings import VerifyLevel


class PartChecks:
    """Checks of the parts of a dataset; threads may share them.

    Args:
        folder: the dataset.
        level: the checks to make.
        description: what the dataset says of itself.
    """

    def __init__(self, folder: Path, level: VerifyLevel, description: Description) -> None:
        self._folder, self._level, self._description = folder, level, description
        runs = description.manifest.runs if description.manifest else ()
        self._runs = {run.name: run for run in runs}
        self._settings = {run.name: run.recipe.unit_settings() for run in runs if run.recipe is not None}
        self._tasks = {task.index: task for task in description.tasks}

    def problems(self, file: str, status: os.stat_result | None, entry: PartEntry | None) -> Iterator[str]:
        """Yields what is wrong with a part.

        Args:
            file: its path relative to the dataset.
            status: its status; None where it is missing.
            entry: its line in the table; None where the table cannot tell.
        """
        if status is None:
            blocked = folder_problem(self._folder, file.rpartition("/")[0])
            yield f"cannot be reached: {blocked[0]} {blocked[1]}" if blocked else "is missing"
            return
        odd = file_problem(status)
        if odd is not None:
            yield odd
        elif entry is not None and status.st_size != entry.size:
            yield f"has {status.st_size} bytes instead of {entry.size}"
        elif self._level != "quick":
            try:
                with Archive(self._folder / file) as archive:
                    yield from self._archive_problems(archive, entry)
            except (StoreError, ManifestError) as error:
                yield words_after(error, self._folder / file)

    def _archive_problems(self, archive: Archive, entry: PartEntry | None) -> Iterator[str]:
        """Problems of an archive whose directory is sound.

        Raises:
            StoreError: its members are not those of its record.
            ManifestError: its record cannot be read.
        """
        if entry is None:
            for name in archive.names:
                archive.read(name)
        elif archive.sha256() != entry.sha256:
            yield "content does not have the recorded sha256"
            return
        record = read_part_record(archive)
        check_members(archive, record)
        if entry is not None:
            yield from self._record_problems(record, entry)
        if self._level == "deep":
            run = self._runs.get(entry.run) if entry else None
            for name, problem in content_problems(archive, record, run.recipe if run else None):
                yield f"{name}: {problem}"

    def _record_problems(self, record: PartRecord, entry: PartEntry) -> Iterator[str]:
        """How a part's record differs from what the dataset says of it."""
        assert self._description.manifest is not None
        run, task = self._runs.get(entry.run), self._tasks.get(entry.task)
        if TASKS in self._description.unreadable:  # a finding of its own; the part tells its task
            task = Task(entry.task, "train", record.identity.parameters)
        if run is None or task is None or entry.platform >= len(self._description.manifest.platforms):
            yield "is of a task, a run or a platform that the dataset does not have"
            return
        if record.platform != self._description.manifest.platforms[entry.platform]:
            yield "was made on another platform than the dataset says"
        yield from identity_problems(
            record,
            entry=entry,
            task=task,
            run=run,
            settings=self._settings.get(entry.run),
            data_version=self._description.manifest.data_version,
        )
