"""A new dataset that is put together from parts, resumably."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tcmrl_data.build.published import Published, read_published
from tcmrl_data.build.work_files import ASSEMBLY, check_work_files
from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.canonical import canonical_json, sha256
from tcmrl_data.foundation.disk import LOCK, STAGING, lock_file, make_folders, remove_abandoned, replace_file
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.plain_files import read_plain_file
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.keys import PartKey, part_file
from tcmrl_data.store.limits import MAX_PARTS
from tcmrl_data.store.manifest import MANIFEST, Derivation, Manifest, Run, Source, read_manifest
from tcmrl_data.store.part_record import PartRecord
from tcmrl_data.store.part_table import PartEntry, PartTable
from tcmrl_data.store.platform import Platform
from tcmrl_data.store.sealing import write_dataset

WRITERS = 8
"""Parts that are written side by side; a disk makes several durable in the time of one."""


@dataclass(frozen=True)
class Copied:
    """A part of a new dataset that is a part of another one, byte for byte.

    Attributes:
        key: in the new dataset.
        source: the other dataset.
        source_key: in that dataset.
    """

    key: PartKey
    source: Dataset
    source_key: PartKey

    @property
    def entry(self) -> PartEntry:
        """The part's line in its source."""
        return self.source.entry(self.source_key)

    @property
    def platform(self) -> Platform:
        """The platform that it was made on."""
        return self.source.manifest.platforms[self.entry.platform]


def derivation_of(operation: str, settings: Mapping[str, Any], sources: Sequence[Dataset]) -> Derivation:
    """What the manifest of a derived dataset says of how it was made.

    Args:
        operation: such as `subset` or `merge`.
        settings: JSON values that the result follows from, together with the sources.
        sources: the datasets that it is made from.
    """
    return Derivation(
        operation=operation,
        settings=dict(settings),
        sources=tuple(Source(label=source.manifest.label, root=source.manifest.root) for source in sources),
        package=version("tcmrl"),
    )


class Assembly:
    """A new dataset that is put together from parts; it exists when its manifest does.

    Parts are published one by one and survive a crash. The same command, given again, finds them and goes on.
    The folder is locked while the assembly is open.

    Args:
        out: the new dataset's folder: free, empty, or one where the same assembly was stopped.
        derivation: what is made; an assembly of another derivation is not continued.
        sources: datasets that are read; they must not change meanwhile.

    Raises:
        StoreError: the folder holds something else.
        LockedError: another process writes to the folder.

    Example:
        >>> with open_assembly(out, derivation, [source]) as assembly:  # doctest: +SKIP
        ...     assembly.copy([Copied(key, source, key) for key in source.parts])
        ...     assembly.finish(tasks=source.tasks, runs=source.manifest.runs)
    """

    def __init__(self, out: Path, derivation: Derivation, sources: Sequence[Dataset]) -> None:
        self._out, self._derivation, self._sources = out, derivation, tuple(sources)
        self._entries: list[PartEntry] = []
        self._platforms: list[Platform] = []

    def holds(self, key: PartKey) -> bool:
        """Whether a part was published before, by an attempt that was stopped."""
        return (self._out / part_file(key)).is_file()

    def copy(
        self,
        parts: Sequence[Copied],
        *,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Copies parts; each is hashed on the way.

        Args:
            parts: the parts.
            progress: called with parts done and parts in all.

        Raises:
            StoreError: a part of a source is missing or damaged; the message names it.
            StorageError: the operating system refuses an operation.
        """
        with ThreadPoolExecutor(WRITERS) as pool:
            for done, part in enumerate(pool.map(self._copy, parts), start=1):
                self._add(part.entry._replace(run=part.key.run), part.platform)
                progress(done, len(parts))

    def write(self, key: PartKey, make: Callable[[], tuple[PartRecord, bytes]]) -> PartEntry:
        """Publishes a new part, unless an attempt that was stopped has done so.

        Args:
            key: the part's.
            make: makes the part's record and archive.
        """
        file = self._out / part_file(key)
        published: Published | None = None
        if self.holds(key):
            with contextlib.suppress(StoreError, ManifestError):  # a damaged part is made again
                published, _ = read_published(file, key.run)
        if published is None:
            record, data = make()
            replace_file(file, data, staging=self._out / STAGING)
            published = Published.of_record(record, run=key.run, archive=data)
        return self._add(published.entry, published.platform)

    def finish(
        self,
        *,
        name: str,
        data_version: int,
        runs: Sequence[Run],
        tasks: Sequence[Task],
        label: str | None = None,
    ) -> Manifest:
        """Writes tables and manifest; the dataset exists from then on.

        Args:
            name: the environment's name.
            data_version: of the parts.
            runs: of the parts.
            tasks: the dataset's tasks.
            label: the dataset's own name.

        Raises:
            StoreError: a source has changed since it was opened, or no part is left.
        """
        for source in self._sources:
            if read_manifest(source.folder).digest != source.manifest.digest:
                raise StoreError(f"{source.folder} has changed meanwhile; run the same command again")
        if not 0 < len(self._entries) <= MAX_PARTS:
            raise StoreError(
                f"{self._out} would have {len(self._entries)} parts; 1 to {MAX_PARTS} are possible"
            )
        manifest = write_dataset(
            self._out,
            name=name,
            label=label,
            data_version=data_version,
            runs=runs,
            derivation=self._derivation,
            platforms=self._platforms,
            tasks=tasks,
            table=PartTable.empty().with_entries(self._entries),
        )
        (self._out / ASSEMBLY).unlink()
        return manifest

    def _copy(self, part: Copied) -> Copied:
        target = self._out / part_file(part.key)
        entry = part.entry
        if not target.is_file() or target.lstat().st_size != entry.size:
            file = part.source.file_of(part.source_key)
            with part.source.open_part(part.source_key) as archive:
                data = archive.content()
            if sha256(data) != entry.sha256:
                raise StoreError(f"{file} does not have the recorded sha256; run `tcmrl-data repair`")
            replace_file(target, data, staging=self._out / STAGING)
        return part

    def _add(self, entry: PartEntry, platform: Platform) -> PartEntry:
        digests = [known.digest() for known in self._platforms]
        if platform.digest() not in digests:
            self._platforms.append(platform)
            digests.append(platform.digest())
        entry = entry._replace(platform=digests.index(platform.digest()))
        self._entries.append(entry)
        return entry


@contextlib.contextmanager
def open_assembly(out: Path, derivation: Derivation, sources: Sequence[Dataset]) -> Iterator[Assembly]:
    """Begins an assembly, or goes on with one that was stopped; arguments and errors as of `Assembly`."""
    note = canonical_json(derivation.model_dump(mode="json"))
    _check_out(out, note)
    make_folders(out)
    with lock_file(out / LOCK, f"dataset {out}"):
        _check_out(out, note)
        remove_abandoned(out)
        replace_file(out / ASSEMBLY, note, staging=out / STAGING)
        yield Assembly(out, derivation, sources)


def _check_out(out: Path, note: bytes) -> None:
    """Refuses a folder that is neither new nor one where the same assembly was stopped."""
    if not out.exists():
        return
    if not out.is_dir():
        raise StoreError(f"--out {out} is a file; choose another folder")
    check_work_files(out)
    begun = out / ASSEMBLY
    if (out / MANIFEST).exists() or (
        {entry.name for entry in out.iterdir()} - {LOCK, STAGING} and not begun.exists()
    ):
        raise StoreError(f"--out {out} exists and is not empty; choose another folder or remove it")
    if begun.exists() and read_plain_file(begun, limit=LARGEST_ARCHIVE) != note:
        raise StoreError(
            f"--out {out} holds the beginning of another dataset; choose another folder or remove it"
        )
