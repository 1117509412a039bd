"""Reading: `open_dataset` → `Dataset`; parts are loaded on first use."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.snapshot import Snapshot, read_snapshot
from tcmrl_data.dataset.selection import Selection, chosen_steps
from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.tasks import Split, Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import ManifestError, SelectionError, StoreError, TaskError, TrajectoryError
from tcmrl_data.foundation.plain_files import folder_problem
from tcmrl_data.foundation.validation import first_problem
from tcmrl_data.store.arrays import read_arrays, unpack
from tcmrl_data.store.layout import ArrayLayout, check_expansion
from tcmrl_data.store.manifest import (
    MANIFEST,
    Manifest,
    PartRecord,
    TaskReferences,
    dataset_folder,
    part_folder,
    read_manifest,
    read_sealed_part,
)
from tcmrl_data.store.part_files import check_files

if TYPE_CHECKING:
    pass


def open_dataset(path: str | Path) -> "Dataset":
    """Opens a dataset, given its folder or its `manifest.json`.

    The manifest's own digests, every file's presence and size, and every `zarr.json` are checked;
    contents are not hashed.

    Raises:
        ManifestError: the manifest or a part's record is missing, truncated, edited or of another version.
        StoreError: a part's file is missing, of another size, linked, outside the allow-list, or a bomb.

    Example:
        >>> dataset = open_dataset("data/point-robot")  # doctest: +SKIP
        >>> dataset.select(split="train", snapshots="last").trajectories(0)  # doctest: +SKIP
    """
    folder = dataset_folder(path)
    dataset = Dataset(folder, read_manifest(folder))
    layouts: list[ArrayLayout] = []
    stored_bytes = 0
    for entry in dataset.manifest.parts:
        problem = folder_problem(folder, part_folder(entry.task, entry.step))
        if problem:
            raise StoreError(f"{folder / problem[0]} {problem[1]}; run `tcmrl-data repair {folder}`")
        record = dataset.part(entry.task, entry.step)
        layouts += check_files(dataset.folder_of(entry.task, entry.step), record)
        stored_bytes += sum(file.size for file in record.files.values())
    check_expansion(layouts, stored_bytes, folder)
    return dataset


class Dataset:
    """A dataset on disk; made by `open_dataset`.

    Attributes:
        folder: where it lies.
        manifest: its manifest.
        tasks: its tasks, ascending by index.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder, self.manifest = folder, manifest
        self.tasks = tuple(Task(task.index, task.split, task.parameters) for task in manifest.tasks)
        self._entries = {(entry.task, entry.step): entry for entry in manifest.parts}
        self._records: dict[tuple[int, int], PartRecord] = {}

    @property
    def name(self) -> str:
        """The environment's name."""
        return self.manifest.name

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
        for task in self.tasks:
            if task.index == index:
                return task
        raise TaskError(f"{self.folder} holds no task {index}; build it with --tasks {index}")

    def snapshots(self, task: int) -> list[int]:
        """Snapshot steps of a task, ascending."""
        return sorted(step for index, step in self._entries if index == task)

    def references(self, task: int) -> TaskReferences:
        """Reference returns of a task: uniform, oracle, scripted, best behavior.

        Raises:
            ManifestError: the task is not complete yet.
        """
        found = self.manifest.references.get(str(task))
        if found is None:
            raise ManifestError(
                f"{self.folder}: task {task} is incomplete; finish it with `tcmrl-data build`"
            )
        return found

    def folder_of(self, task: int, step: int) -> Path:
        """Folder of a part."""
        return self.folder / part_folder(task, step)

    def part(self, task: int, step: int) -> PartRecord:
        """The record of a part, checked against the manifest.

        Raises:
            SelectionError: the dataset has no such part.
            ManifestError: `part.json` is not the file that the manifest names.
        """
        if (task, step) not in self._entries:
            raise SelectionError(f"{self.folder} has no part of task {task} at step {step}")
        if (task, step) not in self._records:
            file = self.folder_of(task, step) / "part.json"
            entry = self._entries[task, step]
            record, sealed = read_sealed_part(file)
            if sealed != entry.sha256 or record.id != entry.id:
                raise ManifestError(
                    f"{file}: is not the record that the manifest names; run `tcmrl-data repair`"
                )
            if (record.identity.task, record.identity.step) != (task, step):
                raise ManifestError(f"{file}: identity.task and identity.step name another part")
            self._records[task, step] = record
        return self._records[task, step]

    def arrays(self, task: int, step: int) -> dict[str, npt.NDArray[Any]]:
        """All arrays of a part: flat steps, observations with one row more per episode, offsets."""
        return read_arrays(self.folder_of(task, step), self.part(task, step).identity.arrays)

    def trajectories(self, task: int, step: int) -> list[Trajectory]:
        """The episodes of a part.

        Raises:
            StoreError: arrays that do not decode or do not form episodes.
        """
        arrays = self.arrays(task, step)
        try:
            return unpack(arrays)
        except (StoreError, TrajectoryError) as error:
            raise StoreError(f"{self.folder_of(task, step)}: {error}; run `tcmrl-data repair`") from None

    def snapshot(self, task: int, step: int) -> Snapshot:
        """The behavior policy of a part."""
        self.part(task, step)
        return read_snapshot(self.folder_of(task, step), step)

    def select(
        self, *, split: Split | None = None, tasks: Sequence[int] | None = None, snapshots: str = "all"
    ) -> Selection:
        """A view of some tasks and snapshots.

        Args:
            split: only tasks of this split.
            tasks: only these indices; one that is named twice counts once.
            snapshots: `all`, `last`, `steps>=N`, or `return>=Q`: of each task, the parts whose mean
                return reaches the quantile Q in [0, 1] of the task's parts.

        Raises:
            SelectionError: the rule cannot be read, or nothing is left of a task.
            TaskError: an index that the dataset does not hold.
        """
        chosen = list(self.tasks)
        if tasks is not None:
            chosen = [self.task(index) for index in dict.fromkeys(tasks)]
        chosen = [task for task in chosen if split is None or task.split == split]
        if not chosen:
            raise SelectionError(
                f"{self.folder}: no {split or 'such'} tasks in the dataset; build some with --tasks"
            )
        return Selection(
            self, tuple(chosen), {task.index: chosen_steps(self, task.index, snapshots) for task in chosen}
        )
