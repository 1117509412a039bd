"""Export: a selection of a dataset in the format of another library."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Split
from tcmrl_data.foundation.canonical import canonical_json, digest
from tcmrl_data.interchange.formats.base import FORMATS, ExportProgress, Format, no_progress
from tcmrl_data.interchange.formats.new_folder import new_folder, require_free
from tcmrl_data.interchange.optional import require_packages
from tcmrl_data.store.tables import task_line


@dataclass(frozen=True)
class ExportReport:
    """What an export wrote, or would write.

    Attributes:
        format: its name.
        out: the new folder.
        tasks: number of tasks.
        parts: number of parts.
        episodes: number of episodes.
        steps: number of steps.
        files: all files, sorted; none where nothing was written.
    """

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
    progress: ExportProgress = no_progress,
) -> ExportReport:
    """Writes a selection of a dataset into a new folder, one part in memory at a time.

    The folder appears under its name when all files are complete, and not at all when something fails. After
    an interruption or a crash, the same call goes on behind the last finished task.

    Args:
        dataset: a complete dataset, or its path.
        format_name: a format, such as `hdf5`.
        out: the folder to create; it may exist if it is empty.
        tasks: only these indices.
        split: only tasks of this split.
        snapshots: a rule of `Dataset.select`.
        tier: a quality tier instead of a rule.
        dry_run: check everything and write nothing.
        progress: called as parts are written.

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
    require_free(out)
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


def _write(exporter: Format, selection: Selection, out: Path, progress: ExportProgress) -> None:
    """Writes the tasks that no earlier attempt has finished."""
    total, done = sum(map(len, selection.parts.values())), 0
    with new_folder(out, _claim(exporter, selection)) as folder:
        for task in selection.tasks:
            name = exporter.place(selection, task)
            if folder.holds(name):
                done += len(selection.parts[task.index])
                progress(done, total)
                continue
            with folder.adding(name) as path:
                for _ in exporter.write(selection, task, path):
                    done += 1
                    progress(done, total)
        for name, content in exporter.accompanying(selection).items():
            folder.add(name, content)


def _claim(exporter: Format, selection: Selection) -> bytes:
    """What an export's files follow from: format, package, tasks and parts."""
    ids = [[*key, selection.dataset.entry(key).id] for keys in selection.parts.values() for key in keys]
    return canonical_json(
        {
            "format": exporter.name,
            "package": version("tcmrl"),
            "dataset": digest([selection.dataset.manifest.digest, selection.rule]),
            "tasks": digest([task_line(task).decode() for task in selection.tasks]),
            "parts": digest(ids),
        }
    )
