"""Export: a selection of a dataset in the format of another library, and the base class of formats.

A format is a plug-in that writes one task. Staging, syncing and publishing of the folder are here.
"""

import abc
import contextlib
import importlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import (
    lock_file,
    move_into_place,
    named_errors,
    remove_tree,
    replace_file,
    require_room,
    sync_files,
)
from tcmrl_data.foundation.errors import MissingPackageError, StorageError, StoreError
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.interchange.reader import EPISODE_ARRAYS, FORMAT_VERSION
from tcmrl_data.recipe.document import AND
from tcmrl_data.store.tables import PartKey

REMEDY = "nothing was exported; make room or choose an --out on another disk, then export again"
FILE_BYTES = 2**16
"""Bytes reserved for a file's content other than episodes."""

COPIES = 4
"""A step is written at most this often: in its episode, and flat with its two observations."""

EPISODE_BYTES = 2**12
"""Room for the records that HDF5 keeps of an episode's arrays; robomimic's take 3 kB."""

LOCK, FILES = "lock", "files"
"""In the staging folder."""


class Format(abc.ABC):
    """Writes datasets task by task; a plug-in of the group `tcmrl.formats`, made without arguments.

    `export_dataset` calls the methods. It stages, syncs and publishes what they write, so that an export
    appears whole or not at all. Optional libraries are imported inside methods, so that other formats work
    without them.
    """

    name: ClassVar[str]
    suffix: ClassVar[str] = ""
    """Of the file of a task."""
    takes_empty_episodes: ClassVar[bool] = False
    """Whether a file can hold an episode without steps."""
    optional_packages: ClassVar[tuple[str, ...]] = ()
    """Modules that the methods import and that an installation without extras lacks."""
    extra: ClassVar[str | None] = None
    """The extra that brings them, such as `tcmrl[minari]`."""

    def place(self, selection: Selection, task: Task) -> str:
        """Path of a task's file or folder within the export."""
        return f"task_{task.index:05d}{self.suffix}"

    @abc.abstractmethod
    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        """Writes a task, and yields the key of every part when it is written.

        Args:
            selection: `selection.parts[task.index]` are the parts to write, in that order, one in memory at
                a time, as `parts` gives them.
            task: one of the selection's.
            path: a new path that ends in `place(selection, task)`; its parent exists.

        Raises:
            StoreError: the format cannot hold an episode.
            StorageError: the disk refuses; the message names the file.
        """

    def accompanying(self, selection: Selection) -> Mapping[str, bytes]:
        """Small files beside those of the tasks: path within the export, and content."""
        return {}

    def attributes(self, selection: Selection, task: Task) -> dict[str, Any]:
        """Numbers and texts that name the task of a file and the dataset that it came from.

        A dataset without a seed, such as an imported one, has no attribute `seed`.
        """
        manifest = selection.dataset.manifest
        attributes = {
            "format": f"tcmrl-{self.name}",
            "format_version": FORMAT_VERSION,
            "environment": manifest.name,
            "task": task.index,
            "split": task.split,
            "parameters": json.dumps(dict(task.parameters), sort_keys=True),
            "dataset_root": manifest.root,
            "recipe": json.dumps(manifest.recipe.unit_settings(), sort_keys=True),
            "citation": manifest.recipe.about.citation,
            "licence": AND.join(manifest.licences),
        }
        return attributes if manifest.seed is None else attributes | {"seed": manifest.seed}

    def parts(
        self, selection: Selection, task: Task, file: Path
    ) -> Iterator[tuple[PartKey, Sequence[Trajectory]]]:
        """The parts of a task with their episodes, each when the file has room for it.

        Args:
            selection: what is exported.
            task: one of the selection's.
            file: that grows; HDF5 leaves a broken process behind where it cannot.

        Raises:
            StoreError: an episode has no steps, and the format cannot hold one.
            StorageError: the disk refuses.
        """
        for key in selection.parts[task.index]:
            trajectories = selection.dataset.trajectories(*key)
            num_bytes = FILE_BYTES + EPISODE_BYTES * len(trajectories)
            for index, trajectory in enumerate(trajectories):
                if not len(trajectory) and not self.takes_empty_episodes:
                    raise StoreError(
                        f"{selection.dataset.file_of(key)}: episode {index} has no steps, which {self.name} "
                        "cannot hold; export with --format hdf5"
                    )
                num_bytes += COPIES * sum(array.nbytes for array in episode_arrays(trajectory).values())
            require_room(file, num_bytes, remedy=REMEDY)
            yield key, trajectories


def episode_arrays(trajectory: Trajectory) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an episode by their names."""
    return {name: getattr(trajectory, name) for name in EPISODE_ARRAYS} | dict(trajectory.extras)


def transitions(
    trajectories: Sequence[Trajectory], *, first: int = 0, step: int = 0
) -> dict[str, npt.NDArray[Any]]:
    """The steps of episodes behind one another, (N, …), by the names of `Trajectory`, and further ones.

    `next_observations`; `episode` (N,) int64 numbers the episodes; `step` (N,) int64 is the snapshot's.

    Args:
        trajectories: at least one; all have the same further arrays.
        first: number of the first episode.
        step: of the snapshot.
    """
    lengths = [len(trajectory) for trajectory in trajectories]
    observations = [trajectory.observations for trajectory in trajectories]
    others = [name for name in episode_arrays(trajectories[0]) if name != "observations"]
    every = [episode_arrays(trajectory) for trajectory in trajectories]
    return {
        "observations": np.concatenate([rows[:-1] for rows in observations]),
        "next_observations": np.concatenate([rows[1:] for rows in observations]),
        **{name: np.concatenate([arrays[name] for arrays in every]) for name in others},
        "episode": np.repeat(np.arange(first, first + len(lengths), dtype=np.int64), lengths),
        "step": np.full(sum(lengths), step, dtype=np.int64),
    }


FORMATS = Registry("tcmrl.formats", "format", Format)


@dataclass(frozen=True)
class ExportReport:
    """What an export wrote to the new folder `out`, or would write; `files` are sorted."""

    format: str
    out: Path
    tasks: int
    parts: int
    episodes: int
    steps: int
    files: tuple[Path, ...] = ()


def export_dataset(
    dataset: str | Path | Dataset,
    format_name: str,
    out: str | Path,
    *,
    tasks: Sequence[int] | None = None,
    split: Split | None = None,
    snapshots: str = "all",
    tier: str | None = None,
    dry_run: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ExportReport:
    """Writes a selection of a dataset into a new folder, one part in memory at a time.

    The folder appears under its name when all files are complete, and not at all when something fails.

    Args:
        dataset: a complete dataset, or its path.
        format_name: a format, such as `hdf5`.
        out: the folder to create; it may exist if it is empty.
        tasks: only these indices.
        split: only tasks of this split.
        snapshots: a rule of `Dataset.select`.
        tier: a quality tier instead of a rule.
        dry_run: check everything and write nothing.
        progress: called with the number of parts written and of all parts.

    Raises:
        UnknownNameError: there is no such format.
        SelectionError: the rule cannot be read or leaves nothing of a task, or the dataset is incomplete.
        TaskError: the dataset lacks a task.
        StoreError: `out` exists and is not empty, a part is damaged, or the format cannot hold an episode.
        LockedError: another process exports to `out`.
        StorageError: the disk refuses; the message names the file.
        MissingPackageError: an optional package is not installed.

    Example:
        >>> import tcmrl_data
        >>> report = tcmrl_data.export_dataset(  # doctest: +SKIP
        ...     "data/point-robot", "hdf5", "data/expert", tier="expert", split="train"
        ... )
        >>> report.files[0]  # doctest: +SKIP
        PosixPath('data/expert/task_00000.hdf5')
    """
    out = Path(out)
    exporter = FORMATS.get(format_name)()
    require_packages(f"format {format_name!r}", exporter.optional_packages, exporter.extra)
    opened = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    selection = opened.select(split=split, tasks=tasks, snapshots=snapshots, tier=tier)
    _require_free(out)
    if not dry_run:
        _write(exporter, selection, out, progress)
    entries = [opened.entry(key) for keys in selection.parts.values() for key in keys]
    return ExportReport(
        format=format_name,
        out=out,
        tasks=len(selection.tasks),
        parts=len(entries),
        episodes=sum(entry.episodes for entry in entries),
        steps=sum(entry.steps for entry in entries),
        files=() if dry_run else tuple(sorted(path for path in out.rglob("*") if path.is_file())),
    )


def require_packages(what: str, packages: Sequence[str], extra: str | None) -> None:
    """Imports packages that only some formats need.

    Args:
        what: needs them, such as `format 'minari'`.
        packages: names of modules.
        extra: what installs them, such as `tcmrl[minari]`; the modules' own names where None.

    Raises:
        MissingPackageError: one of them cannot be imported.
    """
    try:
        for package in packages:
            importlib.import_module(package)
    except ImportError as error:
        raise MissingPackageError(
            f"{what} needs a package that is missing ({error}); pip install '{extra or ' '.join(packages)}'"
        ) from None


def _require_free(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"--out {out} exists and is not empty; choose another folder or remove it")


def _write(
    exporter: Format, selection: Selection, out: Path, progress: Callable[[int, int], None] | None
) -> None:
    total, done = sum(map(len, selection.parts.values())), 0
    with _staged(out) as folder:
        for task in selection.tasks:
            path = folder / exporter.place(selection, task)
            path.parent.mkdir(parents=True, exist_ok=True)
            require_room(path, FILE_BYTES, remedy=REMEDY)
            for _ in exporter.write(selection, task, path):
                done += 1
                if progress is not None:
                    progress(done, total)
        for name, content in exporter.accompanying(selection).items():
            replace_file(folder / name, content)


@contextlib.contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """Gives an empty folder, which is forced to disk and renamed to `out` at the end, or removed.

    Raises:
        StoreError: something else lies where the export is staged, or `out` has appeared meanwhile.
        LockedError: another process exports to `out`.
        StorageError: the disk refuses.
    """
    staged = out.with_name(f".{out.name}.partial")
    folder = staged / FILES
    try:
        with named_errors(out, remedy=REMEDY):
            out.parent.mkdir(parents=True, exist_ok=True)
            is_foreign = staged.exists() and not (staged / LOCK).exists() and any(staged.iterdir())
            if staged.is_symlink() or is_foreign:
                raise StoreError(f"{staged} is in the way, where exports are staged; remove it")
            staged.mkdir(exist_ok=True)
            with lock_file(staged / LOCK, f"the export {out}"):
                try:
                    remove_tree(folder)  # what a killed export left
                    folder.mkdir()
                    yield folder
                    sync_files(folder, filter(Path.is_file, folder.rglob("*")))
                    if not move_into_place(folder, out):
                        raise StoreError(
                            f"--out {out} appeared meanwhile; choose another folder or remove it"
                        )
                finally:
                    remove_tree(staged)
    except StorageError as error:
        raise StorageError(str(error).replace(str(folder), str(out)).replace(str(staged), str(out))) from None
