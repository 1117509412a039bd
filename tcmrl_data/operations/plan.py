"""What a new dataset is to consist of, and its making."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Task
from tcmrl_data.operations.assembly import Copied, open_assembly
from tcmrl_data.parts.making import make_from
from tcmrl_data.parts.operation import Operation, StoredPart, can_be_made_again
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.manifest import Derivation, Manifest, Run
from tcmrl_data.store.part_record import PartRecord

Progress = Callable[[int, int], None]
"""Called with parts done and parts in all."""


@dataclass(frozen=True)
class PlannedPart:
    """A part of the new dataset.

    Attributes:
        key: in the new dataset.
        source: where it comes from.
        source_key: in the source.
        operation: makes the part of the other, without a simulator; None takes the part over as it is.
    """

    key: PartKey
    source: Dataset
    source_key: PartKey
    operation: Operation[Any] | None = None

    def make(self) -> tuple[PartRecord, bytes]:
        """The record and the archive of a part that is made anew.

        Raises:
            StoreError: the part of the source is damaged.
            SelectionError: it has no such array, or no such episode.
        """
        assert self.operation is not None
        source = StoredPart.of(self.source, self.source_key)
        return make_from(self.operation, source, task=self.source.task(self.source_key.task))


@dataclass(frozen=True)
class Plan:
    """A new dataset before it is made.

    Attributes:
        name: the environment's name.
        data_version: of the parts.
        runs: how the parts were made, the first with a recipe.
        tasks: with their splits.
        parts: of the dataset.
        derivation: how it follows from its sources.
        sources: the datasets that are read.
        label: the dataset's own name.
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
        return sum(part.source.entry(part.source_key).size for part in self.parts)


def carry_out(plan: Plan, out: Path, progress: Progress | None = None) -> Manifest:
    """Makes a planned dataset, or finishes one whose making was stopped.

    Raises:
        StoreError: the folder holds something else, a part of a source is damaged, or a source has changed.
        StorageError: the operating system refuses an operation.
        LockedError: another process writes to the folder.
    """
    whole = [part for part in plan.parts if part.operation is None]
    with open_assembly(out, plan.derivation, plan.sources) as assembly:
        assembly.copy(
            [Copied(part.key, part.source, part.source_key) for part in whole],
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
        keys: of the new dataset's parts.
        tasks: of the new dataset.
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
