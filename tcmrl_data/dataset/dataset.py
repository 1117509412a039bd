"""Reading: `open_dataset` → `Dataset`; tables and parts are read when they are first used."""

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt

from tcmrl_data.behavior.snapshot import Snapshot, read_snapshot
from tcmrl_data.dataset.selection import Selection, chosen_parts
from tcmrl_data.dataset.tables import Tables
from tcmrl_data.dataset.view import View, is_view_file, read_view
from tcmrl_data.envs.tasks import Split
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import sha256
from tcmrl_data.foundation.errors import (
    ManifestError,
    SelectionError,
    SnapshotError,
    StoreError,
    TrajectoryError,
)
from tcmrl_data.foundation.plain_files import one_line, read_plain_file
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import read_arrays, unpack
from tcmrl_data.store.keys import MAIN_RUN, PartKey, part_file
from tcmrl_data.store.manifest import Manifest, dataset_folder, read_manifest
from tcmrl_data.store.part_files import check_members
from tcmrl_data.store.part_record import PartRecord, read_part_record

KEPT_RECORDS = 1000
"""Records of parts that stay in memory, about 10 kB each."""


def open_dataset(path: str | Path) -> "Dataset":
    """Opens a dataset, given its folder or its `manifest.json`, or a view file that names parts of one.

    Only the manifest is read, and of a view the view and the source's table of tasks. The other tables are
    read when they are first used, and are checked against the manifest; so is a part's archive.
    `verify_dataset` checks everything.

    Raises:
        ManifestError: the manifest or the view is missing, truncated, edited or of another version, or the
            view's source is not the dataset that the view was made of.

    Example:
        >>> dataset = open_dataset("data/point-robot")  # doctest: +SKIP
        >>> dataset.select(split="train", snapshots="last").trajectories(0)  # doctest: +SKIP
    """
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


class Dataset(Tables):
    """A dataset on disk, or some of its parts by a view; made by `open_dataset`."""

    def __init__(
        self, folder: Path, manifest: Manifest, file: Path | None = None, view: View | None = None
    ) -> None:
        super().__init__(folder, manifest, file, view)
        self._records: dict[PartKey, PartRecord] = {}

    def __reduce__(self) -> tuple[type["Dataset"], tuple[Path, Manifest, Path, View | None]]:
        """Another process gets manifest and view, and reads tables and parts by itself."""
        return Dataset, (self.folder, self.manifest, self.path, self._view)

    def file_of(self, key: PartKey) -> Path:
        """The file of a part's archive."""
        return self.folder / part_file(key)

    def content(self, key: PartKey) -> bytes:
        """The bytes of a part's archive, compared with the table.

        Raises:
            SelectionError: the dataset has no such part.
            StoreError: the archive is missing or damaged.
        """
        entry, file = self.entry(key), self.file_of(key)
        try:
            data = read_plain_file(file, limit=entry.size)
        except (OSError, ValueError) as error:
            raise StoreError(f"{file}: {one_line(error)}; run `tcmrl-data repair`") from None
        if sha256(data) != entry.sha256:
            raise StoreError(f"{file} does not have the recorded sha256; run `tcmrl-data repair`")
        return data

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
                f"{archive.path} has {archive.size} bytes instead of {entry.size}; run `tcmrl-data repair`"
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
            task: index of the task.
            step: snapshot step.
            run: name of the run.
            names: of the arrays; all where None.
        """
        with self._checked_part(PartKey(task, step, run)) as (archive, record):
            return read_arrays(archive, record.identity.arrays if names is None else names)

    def trajectories(self, task: int, step: int, run: str = MAIN_RUN) -> list[Trajectory]:
        """The episodes of a part.

        Raises:
            StoreError: arrays that do not decode or do not form episodes.
        """
        arrays = self.arrays(task, step, run)
        try:
            return unpack(arrays)
        except (StoreError, TrajectoryError) as error:
            file = self.file_of(PartKey(task, step, run))
            raise StoreError(f"{file}: {error}; run `tcmrl-data repair`") from None

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
        """A view of some tasks and snapshots.

        Args:
            split: only tasks of this split.
            tasks: only these indices; one that is named twice counts once.
            snapshots: `all`, `last`, `steps>=N`, `return>=Q`: of each task, the parts whose mean
                return reaches the quantile Q in [0, 1] of the task's parts; or `tier:NAME`.
            tier: a quality tier, such as `medium`; the same as the rule `tier:medium`. `tiers.py` names them.
            allow_test: let training use parts that were made from test tasks.

        Raises:
            SelectionError: the rule cannot be read, or nothing is left of a task.
            TaskError: an index that the dataset does not hold.
        """
        if tier is not None and snapshots != "all":
            raise SelectionError(f"snapshots {snapshots!r} and tier {tier!r} exclude each other; name one")
        rule = snapshots if tier is None else f"tier:{tier}"
        chosen = list(self.tasks)
        if tasks is not None:
            chosen = [self.task(index) for index in dict.fromkeys(tasks)]
        chosen = [task for task in chosen if split is None or task.split == split]
        if not chosen:
            raise SelectionError(
                f"{self.folder}: no {split or 'such'} tasks in the dataset; build some with --tasks"
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
                        f"{archive.path}: is not the part that the manifest names; run `tcmrl-data repair`"
                    )
                check_members(archive, record)
                if len(self._records) >= KEPT_RECORDS:
                    self._records.clear()  # one operation, beside other threads that read
                self._records[key] = record
            yield archive, record
