"""What a new dataset consists of, and how it is put together from parts, resumably."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tcmrl_data.building.work_files import ASSEMBLY, check_work_files
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    lock_file,
    make_folders,
    place_file,
    remove_abandoned,
    replace_file,
    sync_files,
)
from tcmrl_data.foundation.errors import BuildError, StoreError
from tcmrl_data.foundation.files import read_plain_file
from tcmrl_data.foundation.records import canonical_json, sealed, sha256, write_ranges
from tcmrl_data.parts.making import Published, make_from, numbered, publish
from tcmrl_data.parts.operation import Operation, StoredPart, can_be_made_again
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.manifest import (
    Derivation,
    Manifest,
    Run,
    Source,
    is_complete,
    read_manifest,
    totals_of,
    write_dataset,
    write_manifest,
)
from tcmrl_data.store.part import PartRecord, Platform
from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry, PartTable, part_line
from tcmrl_data.store.tables import (
    MAX_PARTS,
    MAX_PLATFORMS,
    MAX_RUNS,
    PartKey,
    TableWriter,
    part_file,
    read_sealed,
)

Progress = Callable[[int, int], None]
"""Called with parts done and parts in all."""


@dataclass(frozen=True)
class PlannedPart:
    """A part of the new dataset.

    Attributes:
        operation: makes the part of the other, without a simulator; None takes the part over as it is.
    """

    key: PartKey
    source: Dataset
    source_key: PartKey
    operation: Operation[Any] | None = None

    @property
    def entry(self) -> PartEntry:
        """The line of the other part in its table."""
        return self.source.entry(self.source_key)

    def make(self) -> tuple[PartRecord, bytes]:
        """The record and the archive of a part that is made anew."""
        assert self.operation is not None
        source = StoredPart.of(self.source, self.source_key)
        return make_from(self.operation, source, task=self.source.task(self.source_key.task))


@dataclass(frozen=True)
class Plan:
    """A new dataset before it is made.

    Attributes:
        runs: how the parts were made, the first with a recipe.
    """

    name: str
    data_version: int
    runs: tuple[Run, ...]
    tasks: tuple[Task, ...]
    parts: tuple[PlannedPart, ...]
    derivation: Derivation
    sources: tuple[Dataset, ...]
    label: str | None = None

    @property
    def num_cut(self) -> int:
        """Number of parts that are made anew."""
        return sum(part.operation is not None for part in self.parts)

    @property
    def bytes(self) -> int:
        """Size of the archives; of parts that are cut, that of the whole parts."""
        return sum(part.entry.size for part in self.parts)


def derivation_of(
    operation: str,
    settings: Mapping[str, Any],
    sources: Sequence[Dataset],
    *,
    splits: Mapping[int, Split] | None = None,
) -> Derivation:
    """What the manifest of a derived dataset says of how it was made.

    Args:
        settings: JSON values that the result follows from, together with the sources.
        splits: of tasks whose split is not as the recipe draws it; None takes them over from the sources.
    """
    if splits is None:
        derivations = [source.manifest.derivation for source in sources]
        splits = dict(item for found in derivations if found for item in found.split_of_tasks().items())
    names: tuple[Split, ...] = ("train", "test")
    members = {name: [task for task, split in splits.items() if split == name] for name in names}
    return Derivation(
        operation=operation,
        settings=dict(settings),
        sources=tuple(Source(label=source.manifest.label, root=source.manifest.root) for source in sources),
        package=version("tcmrl"),
        splits={name: write_ranges(tasks) for name, tasks in members.items()} if splits else None,
    )


class Assembly:
    """A new dataset that is put together from parts; it exists when its manifest does.

    Parts are written one by one; copies are forced to disk together before the manifest is written. The same
    command, given again after a crash, finds sound parts and goes on. The folder is locked while the assembly
    is open.

    Args:
        out: the new dataset's folder: free, empty, or one where the same assembly was stopped.
        derivation: what is made; an assembly of another derivation is not continued.
        sources: datasets that are read; they must not change meanwhile.

    Example:
        >>> with open_assembly(out, derivation, [source]) as assembly:  # doctest: +SKIP
        ...     assembly.copy([PlannedPart(key, source, key) for key in source.parts])
        ...     assembly.finish(tasks=source.tasks, runs=source.manifest.runs)
    """

    def __init__(self, out: Path, derivation: Derivation, sources: Sequence[Dataset]) -> None:
        self._out, self._derivation, self._sources = out, derivation, tuple(sources)
        self._entries: list[PartEntry] = []
        self._platforms: list[Platform] = []
        self._copied: list[Path] = []

    def copy(
        self,
        parts: Sequence[PlannedPart],
        *,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Copies whole parts; each is hashed on the way.

        Raises:
            StoreError: a part of a source is missing or damaged; the message names it.
        """
        make_folders(self._out / STAGING)
        for done, part in enumerate(parts, start=1):
            entry = self._copy(part)
            self._add(entry, part.source.manifest.platforms[entry.platform])
            if progress is not None:
                progress(done, len(parts))
        self._copied += [self._out / part_file(part.key) for part in parts]

    def write(self, key: PartKey, make: Callable[[], tuple[PartRecord, bytes]]) -> PartEntry:
        """Publishes a new part, unless an attempt that was stopped has done so."""
        return self.take(publish(self._out, key, make))

    def take(self, published: Published) -> PartEntry:
        """Adds a part that another process has published in the folder."""
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

        Raises:
            StoreError: a source has changed since it was opened, or no part is left.
        """
        for source in self._sources:
            if open_dataset(source.path).manifest.digest != source.manifest.digest:
                raise StoreError(f"{source.path} has changed meanwhile; run the same command again")
        if not 0 < len(self._entries) <= MAX_PARTS:
            raise StoreError(
                f"{self._out} would have {len(self._entries)} parts; 1 to {MAX_PARTS} are possible"
            )
        sync_files(self._out, self._copied)
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

    def _copy(self, part: PlannedPart) -> PartEntry:
        target, entry = self._out / part_file(part.key), part.entry
        if not holds_part(target, entry):
            place_file(target, part.source.content(part.source_key), staging=self._out / STAGING)
        return entry._replace(run=part.key.run)

    def _add(self, entry: PartEntry, platform: Platform) -> PartEntry:
        if platform not in self._platforms:
            self._platforms.append(platform)
        entry = entry._replace(platform=self._platforms.index(platform))
        self._entries.append(entry)
        return entry


def holds_part(file: Path, entry: PartEntry) -> bool:
    """Whether a part is in its place; after a crash its file may hold anything."""
    try:
        return sha256(read_plain_file(file, limit=entry.size)) == entry.sha256
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def open_assembly(out: Path, derivation: Derivation, sources: Sequence[Dataset]) -> Iterator[Assembly]:
    """Begins an assembly, or goes on with one that was stopped; arguments and errors as of `Assembly`."""
    check_out(out, derivation)
    make_folders(out)
    with lock_file(out / LOCK, f"dataset {out}"):
        check_out(out, derivation)
        remove_abandoned(out)
        replace_file(out / ASSEMBLY, _note(derivation), staging=out / STAGING)
        yield Assembly(out, derivation, sources)


def check_out(out: Path, derivation: Derivation) -> None:
    """Refuses a folder that is neither new nor one where the same assembly was stopped."""
    check_folder(out, _note(derivation))


def check_folder(out: Path, note: bytes) -> None:
    """Refuses a folder that is neither new nor one where what the note says was stopped."""
    if not out.exists():
        return
    if not out.is_dir():
        raise StoreError(f"{out} is a file; choose another folder")
    check_work_files(out)
    begun = out / ASSEMBLY
    if not begun.exists() and {entry.name for entry in out.iterdir()} - {LOCK, STAGING}:
        raise StoreError(f"{out} exists and is not empty; choose another folder or remove it")
    if begun.exists() and read_plain_file(begun, limit=LARGEST_ARCHIVE) != note:
        raise StoreError(f"{out} holds the beginning of another dataset; choose another folder or remove it")


def _note(derivation: Derivation) -> bytes:
    return canonical_json(derivation.model_dump(mode="json"))


def append_parts(dataset: Dataset, *, runs: Sequence[Run], parts: Sequence[Published]) -> Manifest:
    """Adds published parts to a dataset; they belong to it as soon as the new manifest is there.

    The lines of the parts are forced to disk before the manifest that seals them. A crash leaves the dataset
    as it was, with files of parts that the same command finds again. The caller holds the dataset's lock.

    Args:
        parts: the new parts, whose files are in their places.

    Raises:
        BuildError: more parts, runs or platforms than a dataset may have.
    """
    manifest, folder = dataset.manifest, dataset.folder
    if read_manifest(folder).digest != manifest.digest:
        raise StoreError(f"{folder} has changed meanwhile; run the same command again")
    platforms = list(manifest.platforms)
    entries = sorted(numbered(parts, platforms), key=lambda entry: entry.key)
    recorded = dataset.recorded_parts.with_entries(entries)
    for what, found, limit in (
        ("parts", len(recorded), MAX_PARTS),
        ("runs", len(runs), MAX_RUNS),
        ("platforms", len(platforms), MAX_PLATFORMS),
    ):
        if found > limit:
            raise BuildError(f"{folder} would have {found} {what}, more than the {limit} that are allowed")
    table = TableWriter(folder / PARTS_TABLE, read_sealed(folder / PARTS_TABLE, manifest.parts))
    table.append(b"".join(map(part_line, entries)))
    table.sync()
    kept = recorded.without_tasks(manifest.dropped)
    fields = manifest.model_dump(mode="json", exclude={"digest"}) | {
        "runs": [run.model_dump(mode="json") for run in runs],
        "platforms": [platform.model_dump(mode="json") for platform in platforms],
        "parts": table.seal.model_dump(),
        "totals": totals_of(kept).model_dump(),
        "root": kept.root,
        "complete": is_complete(kept, runs, num_tasks=manifest.num_tasks),
    }
    write_manifest(folder, sealed(fields))
    return read_manifest(folder)


def carry_out(plan: Plan, out: Path, progress: Progress | None = None) -> Manifest:
    """Makes a planned dataset, or finishes one whose making was stopped.

    Raises:
        StoreError: the folder holds something else, a part of a source is damaged, or a source has changed.
    """
    whole = [part for part in plan.parts if part.operation is None]
    with open_assembly(out, plan.derivation, plan.sources) as assembly:
        assembly.copy(
            whole,
            progress=None if progress is None else lambda done, _: progress(done, len(plan.parts)),
        )
        made = 0
        for part in plan.parts:
            if part.operation is not None:
                made += 1
                assembly.write(part.key, part.make)
                if progress is not None:
                    progress(len(whole) + made, len(plan.parts))
        return assembly.finish(
            name=plan.name,
            data_version=plan.data_version,
            runs=plan.runs,
            tasks=plan.tasks,
            label=plan.label,
        )


def settle_runs(
    runs: Sequence[Run], keys: Collection[PartKey], tasks: Sequence[Task], *, cut: Collection[str] = ()
) -> tuple[Run, ...]:
    """The runs of a new dataset, one with a recipe first.

    Runs call for their snapshots only if every task has those of every run.

    Args:
        runs: of the sources, under the names of the new dataset.
        cut: names of runs with parts that were made anew.
    """
    counts: dict[str, int] = {}
    planned = {run.name: frozenset(run.steps or ()) for run in runs}
    for key in keys:
        counts[key.run] = counts.get(key.run, 0) + (key.step in planned[key.run])
    kept = [run for run in runs if run.name in counts]
    if all(run.recipe is None for run in kept):
        kept.insert(0, next(run for run in runs if run.recipe is not None))
    has_all = all(
        run.steps is not None and counts.get(run.name, 0) == len(run.steps) * len(tasks) for run in kept
    )
    return tuple(
        run.model_copy(
            update={
                "steps": run.steps if has_all else None,
                "kind": "subset" if run.name in cut and can_be_made_again(run) else run.kind,
            }
        )
        for run in sorted(kept, key=lambda run: run.recipe is None)
    )
