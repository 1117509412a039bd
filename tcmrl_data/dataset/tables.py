"""What a dataset's manifest and tables say; no part is opened."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from tcmrl_data.dataset.view import View
from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.tasks import Split, Task, draw_tasks
from tcmrl_data.foundation.errors import ManifestError, SelectionError, TaskError, TcmrlError
from tcmrl_data.foundation.records import first_problem
from tcmrl_data.store.keys import MAIN_RUN, PartKey
from tcmrl_data.store.manifest import MANIFEST, Manifest
from tcmrl_data.store.part_record import References
from tcmrl_data.store.part_table import PARTS_TABLE, REFERENCES, PartEntry, PartTable, parse_parts
from tcmrl_data.store.tables import read_sealed
from tcmrl_data.store.task_table import TASKS, parse_tasks


class TaskReferences(References):
    """Reference scores of one task; `behavior` is the best snapshot's mean return."""

    behavior: float


class Tables:
    """The manifest of a dataset or of a view of one, and its tables, read when they are first used.

    Attributes:
        folder: where the parts lie.
        manifest: its manifest; of a view, that of a dataset of the view's parts.
        path: what `open_dataset` opens: the folder, or the view's file.
    """

    def __init__(
        self, folder: Path, manifest: Manifest, file: Path | None = None, view: View | None = None
    ) -> None:
        self.folder, self.manifest, self.path = folder, manifest, folder if file is None else file
        self._view = view

    @property
    def sealed_root(self) -> str:
        """Root of the dataset in the folder, of which a view may leave out parts."""
        return self.manifest.root if self._view is None else self._view.source_root

    @property
    def name(self) -> str:
        """The environment's name."""
        return self.manifest.name

    @functools.cached_property
    def recorded_tasks(self) -> tuple[Task, ...]:
        """The tasks of the table, dropped ones too, ascending by index.

        Raises:
            ManifestError: the table of tasks is not the one that the manifest seals.
        """
        file = self.folder / TASKS
        return parse_tasks(read_sealed(file, self.manifest.tasks), file)

    @functools.cached_property
    def recorded_parts(self) -> PartTable:
        """The parts of the table, those of dropped tasks too.

        Raises:
            ManifestError: the table of parts is not the one that the manifest seals.
        """
        file = self.folder / PARTS_TABLE
        return parse_parts(read_sealed(file, self.manifest.parts), file)

    @functools.cached_property
    def tasks(self) -> tuple[Task, ...]:
        """The dataset's tasks, ascending by index; errors as of `recorded_tasks`."""
        dropped = set(self.manifest.dropped)
        splits = self._view.derivation.split_of_tasks() if self._view else {}
        return tuple(
            replace(task, split=splits.get(task.index, task.split))
            for task in self.recorded_tasks
            if task.index not in dropped
        )

    @functools.cached_property
    def parts(self) -> PartTable:
        """The dataset's parts, as its table describes them.

        Raises:
            ManifestError: the table of parts is not the one that the manifest seals, has another root, or
                names a task that the dataset does not have.
        """
        file = self.folder / PARTS_TABLE
        table = self.recorded_parts.without_tasks(self.manifest.dropped)
        if self._view is not None:
            table = table.only(self._view.keys)
        if table.root != self.manifest.root:
            raise ManifestError(f"{file}: its parts do not have the manifest's root; run `tcmrl-data verify`")
        if not set(table.runs) <= {run.name for run in self.manifest.runs}:
            raise ManifestError(f"{file}: names a run that the manifest does not have")
        if not np.isin(table.columns["task"], [task.index for task in self.recorded_tasks]).all():
            raise ManifestError(f"{file}: names a task that {TASKS} does not have")
        return table

    @functools.cached_property
    def environment(self) -> Environment:
        """The environment that the data came from.

        Raises:
            ManifestError: settings that the environment does not take.
            UnknownNameError: no such environment.
        """
        try:
            return self.manifest.recipe.make_environment()
        except ValidationError as error:
            place = f"{self.folder / MANIFEST}: recipe.environment"
            raise ManifestError(f"{place}: {first_problem(error)}") from None

    @property
    def train_tasks(self) -> tuple[Task, ...]:
        """Tasks of the training split."""
        return tuple(task for task in self.tasks if task.split == "train")

    @property
    def test_tasks(self) -> tuple[Task, ...]:
        """Tasks of the test split."""
        return tuple(task for task in self.tasks if task.split == "test")

    def task(self, index: int) -> Task:
        """The task of an index.

        Raises:
            TaskError: the dataset does not hold it.
        """
        task = self._tasks_by_index.get(index)
        if task is None:
            raise TaskError(f"{self.folder} holds no task {index}; build it with --tasks {index}")
        return task

    def split_of(self, task: int) -> Split | None:
        """The split of a task, also of one that the dataset holds no more; None where it is not known."""
        held = self._tasks_by_index.get(task)
        if held is not None:
            return held.split
        derivation = self.manifest.derivation
        recorded = derivation.split_of_tasks() if derivation else {}
        return recorded.get(task) or self._drawn_splits.get(task)

    def snapshots(self, task: int, run: str = MAIN_RUN) -> list[int]:
        """Snapshot steps of a task in a run, ascending."""
        return [key.step for key in self.parts.keys_of(task) if key.run == run]

    def missing(self, task: int) -> list[PartKey]:
        """The parts that a task lacks of those that the manifest's runs call for."""
        present = set(self.parts.keys_of(task))
        wanted = (PartKey(task, step, run.name) for run in self.manifest.runs for step in run.steps or ())
        return sorted(set(wanted) - present)

    def references(self, task: int) -> TaskReferences:
        """Reference returns of a task: uniform, oracle, scripted, best behavior.

        Raises:
            ManifestError: the task is not complete yet.
        """
        keys = self.parts.keys_of(task)
        if not keys or self.missing(task):
            raise ManifestError(
                f"{self.folder}: task {task} is incomplete; finish it with `tcmrl-data build`"
            )
        entries = [self.entry(key) for key in keys]
        first = {name: getattr(entries[0], name) for name in REFERENCES}
        return TaskReferences(**first, behavior=max(entry.mean for entry in entries))

    def entry(self, key: PartKey) -> PartEntry:
        """What the table says of a part.

        Raises:
            SelectionError: the dataset has no such part.
        """
        entry = self.parts.entry(key)
        if entry is None:
            raise SelectionError(f"{self.folder} has no part of {key}")
        return entry

    @functools.cached_property
    def _tasks_by_index(self) -> dict[int, Task]:
        return {task.index: task for task in self.tasks}

    @functools.cached_property
    def _drawn_splits(self) -> dict[int, Split]:
        """Splits of all tasks as the recipe draws them; none where the environment cannot be made."""
        try:
            return {task.index: task.split for task in draw_tasks(self.environment)}
        except TcmrlError:
            return {}
