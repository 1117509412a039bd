"""Reading: `open_dataset` → `Dataset` → `Selection`; views over parts, loaded only when asked for."""

import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.environment import Environment
from tcmrl_data.errors import ManifestError, SelectionError, StoreError, TaskError, TrajectoryError
from tcmrl_data.layout import ArrayLayout, check_expansion
from tcmrl_data.manifest import (
    MANIFEST,
    Manifest,
    PartRecord,
    TaskReferences,
    part_folder,
    read_manifest,
    read_sealed_part,
)
from tcmrl_data.part_files import check_files
from tcmrl_data.plain_files import folder_problem
from tcmrl_data.recipe import first_problem
from tcmrl_data.snapshot import Snapshot, read_snapshot
from tcmrl_data.store import read_arrays, unpack
from tcmrl_data.tasks import Split, Task
from tcmrl_data.trajectory import Trajectory

if TYPE_CHECKING:
    from tcmrl_data.sampler import BatchSizes, Sampler
    from tcmrl_data.torch_dataset import TrajectoryDataset


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
    folder = Path(path).parent if Path(path).name == MANIFEST else Path(path)
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
        self.tasks = tuple(Task(each.index, each.split, each.parameters) for each in manifest.tasks)
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
    ) -> "Selection":
        """A view of some tasks and snapshots.

        Args:
            split: only tasks of this split.
            tasks: only these indices.
            snapshots: `all`, `last`, `steps>=N`, or `return>=Q`: of each task, the parts whose mean
                return reaches the quantile Q in [0, 1] of the task's parts.

        Raises:
            SelectionError: the rule cannot be read, or nothing is left of a task.
            TaskError: an index that the dataset does not hold.
        """
        chosen = [self.task(index) for index in tasks] if tasks is not None else list(self.tasks)
        chosen = [task for task in chosen if split is None or task.split == split]
        if not chosen:
            raise SelectionError(
                f"{self.folder}: no {split or 'such'} tasks in the dataset; build some with --tasks"
            )
        return Selection(
            self, tuple(chosen), {task.index: self._steps(task.index, snapshots) for task in chosen}
        )

    def to_torch_dataset(
        self,
        *,
        split: Split | None = None,
        tasks: Sequence[int] | None = None,
        snapshots: str = "all",
        kept_parts: int | None = None,
    ) -> "TrajectoryDataset":
        """`select(...)`, then `Selection.to_torch_dataset`."""
        selection = self.select(split=split, tasks=tasks, snapshots=snapshots)
        return selection.to_torch_dataset(kept_parts=kept_parts)

    def _steps(self, task: int, rule: str) -> tuple[int, ...]:
        steps = self.snapshots(task)
        missing = sorted(set(self.manifest.steps) - set(steps))
        if missing:
            raise SelectionError(
                f"{self.folder}: task {task} lacks snapshots {missing}; finish it with `tcmrl-data build`"
            )
        match = re.fullmatch(r"all|last|steps>=(\d+)|return>=(0(?:\.\d+)?|1(?:\.0+)?)", rule.replace(" ", ""))
        if match is None:
            raise SelectionError(
                f"snapshots {rule!r}: expected all, last, steps>=N or return>=Q with Q in [0, 1]"
            )
        if rule == "last":
            steps = steps[-1:]
        elif match[1]:
            steps = [step for step in steps if step >= int(match[1])]
        elif match[2]:
            means = {step: self.part(task, step).statistics.mean for step in steps}
            threshold = np.quantile(list(means.values()), float(match[2]))
            steps = [step for step in steps if means[step] >= threshold]
        if not steps:
            raise SelectionError(
                f"{self.folder}: snapshots {rule!r} leaves nothing of task {task}, "
                f"which has {list(self.manifest.steps)}"
            )
        return tuple(steps)


@dataclass(frozen=True)
class Selection:
    """Some tasks and snapshots of a dataset; a view, nothing is loaded.

    Attributes:
        dataset: where it comes from.
        tasks: the selected tasks.
        steps: task index to snapshot steps.
    """

    dataset: Dataset
    tasks: tuple[Task, ...]
    steps: dict[int, tuple[int, ...]]

    def to_torch_dataset(self, *, kept_parts: int | None = None) -> "TrajectoryDataset":
        """The selected episodes as a map-style `torch.utils.data.Dataset`; parts are read when asked for.

        Args:
            kept_parts: parts that stay in memory after they were read; all of them where None.
        """
        from tcmrl_data.torch_dataset import TrajectoryDataset

        return TrajectoryDataset(self, kept_parts=kept_parts)

    def trajectories(self, task: int) -> list[Trajectory]:
        """All selected episodes of a task, snapshot by snapshot."""
        return [each for step in self.steps[task] for each in self.dataset.trajectories(task, step)]

    def sampler(
        self,
        sizes: "BatchSizes",
        *,
        seed: int,
        stream: int = 0,
        device: str = "cpu",
        memory_limit: int | None = None,
        say: Callable[[str], None] = lambda message: None,
    ) -> "Sampler":
        """Loads the selection once and serves meta-training batches from it.

        Args:
            sizes: what a batch holds.
            seed: of the run; batch n is a function of (seed, stream, n).
            stream: further streams of batches under the same seed.
            device: where batches are to be.
            memory_limit: bytes that the decoded steps may take in memory, half of what is available if left
                out; larger selections are decoded into the cache once and read from there.
            say: told when the cache is used.

        Raises:
            SelectionError: the selection holds test tasks, fewer than two tasks, or too little of one.
        """
        from tcmrl_data.cache import load_rows
        from tcmrl_data.sampler import Sampler

        test = [task.index for task in self.tasks if task.split == "test"]
        if test:
            raise SelectionError(f"test tasks {test} must not be trained on; select split='train'")
        if len(self.tasks) < 2:
            raise SelectionError(
                f"meta-training needs at least 2 training tasks, the selection has {len(self.tasks)}"
            )
        return Sampler(
            load_rows(self, memory_limit=memory_limit, say=say),
            sizes,
            seed=seed,
            stream=stream,
            environment=self.dataset.name,
            place=str(self.dataset.folder),
            device=device,
        )
