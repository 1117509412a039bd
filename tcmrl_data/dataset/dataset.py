"""Reading: `open_dataset` → `Dataset`; tables and parts are read when they are first used."""

import contextlib
import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.base import Snapshot, read_snapshot
from tcmrl_data.dataset.selection import Selection, ViewFile, chosen_parts, is_view_file, read_view
from tcmrl_data.envs.base import Environment, Split, Task, draw_tasks
from tcmrl_data.envs.own import OWN_ENVIRONMENTS
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import (
    ManifestError,
    SelectionError,
    SnapshotError,
    StoreError,
    TaskError,
    TcmrlError,
    TrajectoryError,
    UnknownNameError,
)
from tcmrl_data.foundation.records import first_problem
from tcmrl_data.remote.address import Address, is_url, parse_address
from tcmrl_data.remote.files import RemoteFiles, open_remote
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import read_arrays, unpack
from tcmrl_data.store.manifest import MANIFEST, Manifest, dataset_folder, read_manifest
from tcmrl_data.store.part import PartRecord, References, check_members, read_part_record
from tcmrl_data.store.part_table import PARTS_TABLE, REFERENCES, PartEntry, PartTable, parse_parts, read_part
from tcmrl_data.store.tables import MAIN_RUN, TASKS, PartKey, parse_tasks, part_file, read_sealed

KEPT_RECORDS = 1000
"""Records of parts that stay in memory, about 10 kB each."""


def open_dataset(path: str | Path | Address) -> "Dataset":
    """Opens a dataset, given its folder, its `manifest.json` or its address, or a view file of one.

    Only the manifest is read, and of a view the view and the source's table of tasks. The other tables are
    read when they are first used, and are checked against the manifest; so is a part's archive.
    `verify_dataset` checks everything.

    Of a dataset at an address, such as `s3://bucket/point-robot` or `https://…`, manifest and tables are
    fetched into the cache, and a part when it is first used; `Dataset.fetch` brings many at a time.

    Raises:
        ManifestError: the manifest or the view is missing, truncated, edited or of another version, or the
            view's source is not the dataset that the view was made of.
        RemoteError: there is no dataset at the address, or its server does not give it.

    Example:
        >>> dataset = open_dataset("data/point-robot")  # doctest: +SKIP
        >>> dataset.select(split="train", snapshots="last").trajectories(0)  # doctest: +SKIP
    """
    if isinstance(path, Address) or is_url(path):
        remote, manifest = open_remote(parse_address(path))
        return Dataset(remote.folder, manifest, remote=remote)
    if is_view_file(path):
        return _open_view(Path(path))
    folder = dataset_folder(path)
    return Dataset(folder, read_manifest(folder))


def _open_view(file: Path) -> "Dataset":
    view = read_view(file)
    folder = Path(os.path.normpath(file.resolve().parent / view.source))
    try:
        source = Dataset(folder, read_manifest(folder))
    except ManifestError as error:
        raise ManifestError(f"{file} is a view of {folder}: {error}") from None
    if source.manifest.root != view.source_root:
        raise ManifestError(
            f"{file} is a view of a dataset with root {view.source_root[:12]}, {folder} has "
            f"{source.manifest.root[:12]}; put that dataset there, or derive the view again"
        )
    manifest = view.manifest_of(source.manifest, [task.index for task in source.recorded_tasks])
    return Dataset(folder, manifest, file=file, view=view)


class TaskReferences(References):
    """Reference scores of one task; `behavior` is the best snapshot's mean return."""

    behavior: float


class Dataset:
    """A dataset on disk or at an address, or some of its parts by a view; made by `open_dataset`.

    Attributes:
        folder: where manifest and tables lie, and the parts unless the dataset is at an address.
        manifest: its manifest; of a view, that of a dataset of the view's parts.
        path: what `open_dataset` opens: the folder, the view's file, or the address.
        remote: fetches the parts of a dataset at an address; None for one on this disk.
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        file: Path | None = None,
        view: ViewFile | None = None,
        remote: RemoteFiles | None = None,
    ) -> None:
        self.folder, self.manifest = folder, manifest
        self.path: Path | Address = remote.address if remote else folder if file is None else file
        self._view, self.remote = view, remote
        self._file = file
        self._records: dict[PartKey, PartRecord] = {}

    def __repr__(self) -> str:
        name, totals = self.manifest.label or self.manifest.name, self.manifest.totals
        tasks, parts = self.manifest.num_tasks, totals.parts
        return f"<Dataset {str(self.path)!r}: {name}, {tasks:,} tasks, {parts:,} parts>"

    def __reduce__(
        self,
    ) -> tuple[type["Dataset"], tuple[Path, Manifest, Path | None, ViewFile | None, RemoteFiles | None]]:
        """Another process gets manifest and view, and reads tables and parts by itself."""
        return Dataset, (self.folder, self.manifest, self._file, self._view, self.remote)

    @property
    def path_on_disk(self) -> Path:
        """`path`, for what needs the dataset's own files.

        Raises:
            ManifestError: the dataset is at an address.
        """
        return dataset_folder(self.path) if isinstance(self.path, Address) else self.path

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
            ManifestError: the table of tasks is not the one that the manifest seals, or has none of those of
                the parts.
        """
        file = self.folder / TASKS
        tasks = parse_tasks(read_sealed(file, self.manifest.tasks), file)
        if not tasks and self.manifest.parts.lines:
            raise ManifestError(f"{self.folder / PARTS_TABLE}: names a task that {TASKS} does not have")
        return tasks

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
        except UnknownNameError as error:
            remedy = f"if its class stands in a file of yours, export {OWN_ENVIRONMENTS}=FILE.py:CLASS"
            raise UnknownNameError(f"{error} Or {remedy}") from None

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
            raise TaskError(f"{self.path} holds no task {index}; build it with --tasks {index}")
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
            raise ManifestError(f"{self.path}: task {task} is incomplete; finish it with `tcmrl-data build`")
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
            raise SelectionError(f"{self.path} has no part of {key}")
        return entry

    def file_of(self, key: PartKey) -> Path:
        """The file of a part's archive; of a dataset at an address in the cache, where it is fetched to.

        Raises:
            SelectionError: the dataset has no such part.
            RemoteError: the part is not in the cache and cannot be fetched.
        """
        return self.folder / part_file(key) if self.remote is None else self.remote.file(self.entry(key))

    def fetch(
        self,
        parts: Selection | Iterable[PartKey] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Brings parts of a dataset at an address into the cache, several at a time; else does nothing.

        Args:
            parts: a selection of this dataset, or keys; all where None.
            progress: called with bytes that arrived, and bytes in all.

        Raises:
            RemoteError: a part cannot be fetched; those that arrived stay.
        """
        if self.remote is not None:
            keys = itertools.chain(*parts.parts.values()) if isinstance(parts, Selection) else parts
            self.remote.fetch(map(self.entry, self.parts if keys is None else keys), progress)

    def content(self, key: PartKey) -> bytes:
        """The bytes of a part's archive, compared with the table.

        Raises:
            SelectionError: the dataset has no such part.
            StoreError: the archive is missing or damaged.
        """
        return read_part(self.file_of(key), self.entry(key))

    def open_part(self, key: PartKey) -> Archive:
        """Opens a part's archive, to be closed by the caller.

        Raises:
            SelectionError: the dataset has no such part.
            StoreError: the archive is missing, damaged, or of another size.
        """
        entry = self.entry(key)
        archive = Archive(self.file_of(key))
        if archive.size != entry.size:
            archive.close()
            raise StoreError(
                f"{archive.path} has {archive.size} bytes instead of {entry.size}; "
                "run `tcmrl-data verify --repair`"
            )
        return archive

    def part(self, task: int, step: int, run: str = MAIN_RUN) -> PartRecord:
        """The record of a part; its archive is checked when it is first used.

        Raises:
            SelectionError: the dataset has no such part.
            StoreError: the archive does not hold exactly the files that its record calls for.
            ManifestError: its record is not that of the part that the table names.
        """
        key = PartKey(task, step, run)
        record = self._records.get(key)
        if record is None:
            with self._checked_part(key) as (_, record):
                pass
        return record

    def arrays(
        self, task: int, step: int, run: str = MAIN_RUN, *, names: Iterable[str] | None = None
    ) -> dict[str, npt.NDArray[Any]]:
        """Arrays of a part: flat steps, observations with one row more per episode, offsets.

        Args:
            names: of the arrays; all where None.
        """
        with self._checked_part(PartKey(task, step, run)) as (archive, record):
            return read_arrays(archive, record.identity.arrays if names is None else names)

    def trajectories(self, task: int, step: int, run: str = MAIN_RUN) -> list[Trajectory]:
        """The episodes of a part.

        Raises:
            SelectionError: the dataset has no such part.
            StoreError: arrays that do not decode or do not form episodes.
        """
        arrays = self.arrays(task, step, run)
        try:
            return unpack(arrays)
        except (StoreError, TrajectoryError) as error:
            file = self.file_of(PartKey(task, step, run))
            raise StoreError(f"{file}: {error}; run `tcmrl-data verify --repair`") from None

    def snapshot(self, task: int, step: int, run: str = MAIN_RUN) -> Snapshot:
        """The behavior policy of a part.

        Raises:
            SnapshotError: the part has none, or it cannot be read.
        """
        with self._checked_part(PartKey(task, step, run)) as (archive, record):
            place = str(archive.path)
            if record.identity.policy is None:
                raise SnapshotError(
                    f"{place}: holds no policy, since its source does not say which one acted"
                )
            return read_snapshot(archive.read, step, place=place)

    def select(
        self,
        *,
        split: Split | None = None,
        tasks: Sequence[int] | None = None,
        snapshots: str = "all",
        tier: str | None = None,
        allow_test: bool = False,
    ) -> Selection:
        """Some tasks and snapshots of the dataset; reads the tables alone.

        Args:
            tasks: only these indices; one that is named twice counts once.
            snapshots: `all`, `last`, `steps>=N`, `return>=Q`: of each task, the parts whose mean
                return reaches the quantile Q in [0, 1] of the task's parts; or `tier:NAME`.
            tier: a quality tier, such as `medium`; the same as the rule `tier:medium`; `TIERS` lists them.
            allow_test: let training use parts that were made from test tasks.

        Raises:
            SelectionError: the rule cannot be read, or nothing is left of a task.
            TaskError: an index that the dataset does not hold.
        """
        if split not in (None, *get_args(Split)):
            raise SelectionError(f"split {split!r} is unknown; expected 'train' or 'test'")
        if tier is not None and snapshots != "all":
            raise SelectionError(f"snapshots {snapshots!r} and tier {tier!r} exclude each other; name one")
        rule = snapshots if tier is None else f"tier:{tier}"
        chosen = list(self.tasks)
        if tasks is not None:
            chosen = [self.task(index) for index in dict.fromkeys(tasks)]
        chosen = [task for task in chosen if split is None or task.split == split]
        if not chosen:
            raise SelectionError(
                f"{self.path}: no {split or 'such'} tasks in the dataset; build some with --tasks"
            )
        parts = {task.index: chosen_parts(self, task.index, rule) for task in chosen}
        return Selection(self, tuple(chosen), parts, allow_test, rule)

    @contextlib.contextmanager
    def _checked_part(self, key: PartKey) -> Iterator[tuple[Archive, PartRecord]]:
        """The opened archive of a part and its record, which is read and checked once."""
        with self.open_part(key) as archive:
            record = self._records.get(key)
            if record is None:
                record = read_part_record(archive)
                if record.id != self.entry(key).id or (record.identity.task, record.identity.step) != key[:2]:
                    raise ManifestError(
                        f"{archive.path}: is not the part that the manifest names; "
                        "run `tcmrl-data verify --repair`"
                    )
                check_members(archive, record)
                if len(self._records) >= KEPT_RECORDS:
                    self._records.clear()  # one operation, beside other threads that read
                self._records[key] = record
            yield archive, record

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
