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
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.files import read_plain_file
from tcmrl_data.foundation.records import canonical_json, write_ranges
from tcmrl_data.parts.jobs import DeriveSpec, derive_parts
from tcmrl_data.parts.making import Published, make_from, numbered, publish
from tcmrl_data.parts.operation import Operation, StoredPart, can_be_made_again
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.manifest import Derivation, Manifest, Run, Source, write_dataset
from tcmrl_data.store.part import DATA_VERSION, PartRecord, Platform
from tcmrl_data.store.part_table import PartEntry, PartTable, read_part
from tcmrl_data.store.tables import MAX_PARTS, PartKey, part_file

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
        spec: of further parts, which workers make.
    """

    runs: Sequence[Run]
    tasks: Sequence[Task]
    parts: Sequence[PlannedPart]
    derivation: Derivation
    sources: Sequence[Dataset]
    label: str | None = None
    spec: DeriveSpec | None = None

    @property
    def num_cut(self) -> int:
        """Number of parts that are cut from others."""
        return sum(part.operation is not None for part in self.parts)


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
        ...     for key in source.parts:
        ...         assembly.copy(PlannedPart(key, source, key))
        ...     assembly.finish(tasks=source.tasks, runs=source.manifest.runs)
    """

    def __init__(self, out: Path, derivation: Derivation, sources: Sequence[Dataset]) -> None:
        self._out, self._derivation, self._sources = out, derivation, tuple(sources)
        self._parts: list[Published] = []
        self._copied: list[Path] = []

    def copy(self, part: PlannedPart) -> None:
        """Copies a whole part, which is hashed on the way.

        Raises:
            StoreError: the part is missing or damaged; the message names it.
        """
        target, entry = self._out / part_file(part.key), part.source.entry(part.source_key)
        if not holds_part(target, entry):
            place_file(target, part.source.content(part.source_key), staging=self._out / STAGING)
        self._copied.append(target)
        platform = part.source.manifest.platforms[entry.platform]
        self.take(Published(entry._replace(run=part.key.run), platform))

    def write(self, key: PartKey, make: Callable[[], tuple[PartRecord, bytes]]) -> PartEntry:
        """Publishes a new part, unless an attempt that was stopped has done so."""
        published = publish(self._out, key, make)
        self.take(published)
        return published.entry

    def take(self, published: Published) -> None:
        """Adds a part that is in its place in the folder."""
        self._parts.append(published)

    def finish(self, *, runs: Sequence[Run], tasks: Sequence[Task], label: str | None = None) -> Manifest:
        """Writes tables and manifest; the dataset exists from then on.

        Raises:
            StoreError: a source has changed since it was opened, or no part is left.
        """
        for source in self._sources:
            if open_dataset(source.path).manifest.digest != source.manifest.digest:
                raise StoreError(f"{source.path} has changed meanwhile; run the same command again")
        if not 0 < len(self._parts) <= MAX_PARTS:
            raise StoreError(
                f"{self._out} would have {len(self._parts)} parts; 1 to {MAX_PARTS} are possible"
            )
        sync_files(self._out, self._copied)
        platforms: list[Platform] = []
        manifest = write_dataset(
            self._out,
            label=label,
            data_version=self._sources[0].manifest.data_version if self._sources else DATA_VERSION,
            runs=runs,
            derivation=self._derivation,
            table=PartTable.empty().with_entries(numbered(self._parts, platforms)),
            platforms=platforms,
            tasks=tasks,
        )
        (self._out / ASSEMBLY).unlink()
        return manifest


def holds_part(file: Path, entry: PartEntry) -> bool:
    """Whether a part is in its place; after a crash its file may hold anything."""
    try:
        read_part(file, entry)
    except StoreError:
        return False
    return True


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


def carry_out(
    plan: Plan, out: Path, progress: Progress | None = None, *, workers: int | None = None
) -> Manifest:
    """Makes a planned dataset, or finishes one whose making was stopped.

    Raises:
        BuildError: a worker failed; what was published is kept.
        StoreError: the folder holds something else, a part of a source is damaged, or a source has changed.
    """
    ready = len(plan.parts)
    total = ready + (len(plan.spec.jobs) if plan.spec is not None else 0)
    with open_assembly(out, plan.derivation, plan.sources) as assembly:
        whole_first = sorted(plan.parts, key=lambda part: part.operation is not None)
        for done, part in enumerate(whole_first, start=1):
            if part.operation is None:
                assembly.copy(part)
            else:
                assembly.write(part.key, part.make)
            if progress is not None:
                progress(done, total)
        if plan.spec is not None:
            made = derive_parts(plan.spec, workers=workers, progress=shifted(progress, ready, total))
            for published in made:
                assembly.take(published)
        return assembly.finish(runs=plan.runs, tasks=plan.tasks, label=plan.label)


def shifted(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Progress of some of all parts, told as that of all."""
    return None if progress is None else lambda done, _: progress(before + done, total)


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
