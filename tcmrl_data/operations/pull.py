"""Pulling: a dataset at an address becomes a folder of this disk, whole or by a selection."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.work_files import ASSEMBLY, check_work_files
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Split
from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    lock_file,
    make_folders,
    remove_abandoned,
    replace_file,
    sync_files,
)
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.operations.assembly import check_folder, holds_part
from tcmrl_data.operations.derive import derive_dataset
from tcmrl_data.remote.address import parse_address
from tcmrl_data.remote.files import counted
from tcmrl_data.remote.objects import each
from tcmrl_data.store.manifest import MANIFEST, read_manifest, write_manifest
from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry
from tcmrl_data.store.tables import TASKS, part_file

BytesProgress = Callable[[int, int], None]
"""Takes the number of bytes that are there, and of all."""


@dataclass(frozen=True)
class PullReport:
    """What a pull did.

    Attributes:
        fetched_parts: number of parts that were not there yet.
    """

    out: Path
    root: str
    parts: int
    fetched_parts: int
    fetched_bytes: int


def pull_dataset(
    url: str,
    out: str | Path,
    *,
    tasks: Sequence[int] | None = None,
    split: Split | None = None,
    snapshots: str = "all",
    tier: str | None = None,
    progress: BytesProgress | None = None,
) -> PullReport:
    """Makes a folder of this disk from a dataset at an address. The same call goes on after an interruption.

    Without a selection the folder holds the same dataset. With one it holds what `derive_dataset` makes of
    the selection, and only the parts of that are fetched, through the cache.

    Args:
        url: such as `s3://bucket/point-robot` or `https://host/point-robot`, with `@TAG` behind it for a tag.
        out: the folder: free, empty, or one where the same pull was stopped, or had ended.
        snapshots: a rule of `Dataset.select`, instead of a tier.
        tier: a quality tier, such as `medium`.
        progress: called with bytes that are there, and bytes in all.

    Raises:
        RemoteError: there is no dataset at the address, or the server does not give it as it was sealed.
        ManifestError: manifest or tables are damaged, or of another version.
        SelectionError, TaskError: the selection cannot be read, or leaves nothing of a task.
        StoreError: the folder holds something else.
        StorageError: the operating system refuses an operation.

    Example:
        >>> pull_dataset("s3://bucket/point-robot@v1", "data/point-robot", tier="medium")  # doctest: +SKIP
    """
    out, address = Path(out), parse_address(url)
    source = open_dataset(address)
    if (tasks, split, snapshots, tier) == (None, None, "all", None):
        return _pull_whole(source, out, progress)
    selection = source.select(tasks=tasks, split=split, snapshots=snapshots, tier=tier)
    entries = [source.entry(key) for keys in selection.parts.values() for key in keys]
    missing = [entry for entry in entries if not holds_part(out / part_file(entry.key), entry)]
    source.fetch(selection, progress)
    made = derive_dataset(source, out, tasks=tasks, split=split, snapshots=snapshots, tier=tier)
    assert made.root is not None  # nothing is cut
    return PullReport(out, made.root, made.parts, len(missing), sum(entry.size for entry in missing))


def _pull_whole(source: Dataset, out: Path, progress: BytesProgress | None) -> PullReport:
    remote = source.remote
    assert remote is not None  # it was opened by an address
    note = f"pull of {source.manifest.digest}\n".encode()
    _check_out(out, source, note)
    make_folders(out)
    with lock_file(out / LOCK, f"dataset {out}"):
        _check_out(out, source, note)
        remove_abandoned(out)
        replace_file(out / ASSEMBLY, note, staging=out / STAGING)
        entries = [source.entry(key) for key in source.parts]
        missing = [entry for entry in entries if not holds_part(out / part_file(entry.key), entry)]
        total, lacking = (sum(entry.size for entry in group) for group in (entries, missing))
        say = counted(progress, total, total - lacking)

        def fetch(entry: PartEntry) -> None:
            remote.copy(entry, out / part_file(entry.key), staging=out / STAGING, say=say)

        each(fetch, missing)
        for name in (TASKS, PARTS_TABLE):
            replace_file(out / name, (source.folder / name).read_bytes(), staging=out / STAGING)
        sync_files(out, [out / part_file(entry.key) for entry in missing])
        write_manifest(out, (source.folder / MANIFEST).read_bytes())
        (out / ASSEMBLY).unlink()
    if read_manifest(out).digest != source.manifest.digest:
        raise StoreError(f"{out} changed while it was written; run the same command again")
    return PullReport(out, source.manifest.root, len(entries), len(missing), lacking)


def _check_out(out: Path, source: Dataset, note: bytes) -> None:
    """Refuses a folder that is neither new, nor that of this dataset, nor one where its pull was stopped."""
    if not (out / MANIFEST).exists():
        check_folder(out, note)
        return
    check_work_files(out)
    if read_manifest(out).digest != source.manifest.digest:
        raise StoreError(f"{out} holds another dataset than {source.path}; choose another folder")
