"""Merging: the union of datasets of one environment; nothing of it depends on the order of the sources."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import canonical_json, differences, digest
from tcmrl_data.operations.assembly import (
    Plan,
    PlannedPart,
    Progress,
    carry_out,
    check_out,
    derivation_of,
    settle_runs,
)
from tcmrl_data.operations.derive import Derived, check_label, summary
from tcmrl_data.recipe.document import merged_about
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part_table import PartEntry
from tcmrl_data.store.tables import MAIN_RUN, RUN_NAME, PartKey


def merge_datasets(
    sources: Sequence[str | Path | Dataset],
    out: str | Path,
    *,
    names: Sequence[str] | None = None,
    split_from: str | Path | Dataset | None = None,
    label: str | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Derived:
    """Makes the union of datasets; parts keep ids and bytes, and their order does not matter.

    The sources have the same environment settings, and the tasks that several of them hold have the same
    parameters. A part that several sources hold is taken once. Parts with equal keys and other ids, such as
    those of other seeds, become another run.

    Args:
        sources: datasets or views, at least two.
        names: of the run `main` of each source in the union; without names, runs keep theirs where they are
            free, and the others are called by their seed or kind.
        split_from: the source that decides which tasks are training tasks, where sources disagree.

    Raises:
        SelectionError: fewer than two sources, or sources that disagree; names what, and both values.
        StoreError: `out` exists, a part is damaged, or a source has changed meanwhile.
        StorageError: the operating system refuses an operation.
        LockedError: another process writes to `out`.

    Example:
        >>> merge_datasets(["data/pr-seed0", "data/pr-seed1"], "data/pr-two-seeds")  # doctest: +SKIP
    """
    check_label(label)
    opened = [source if isinstance(source, Dataset) else open_dataset(source) for source in sources]
    if len(opened) < 2 or (names is not None and len(names) != len(opened)):
        raise SelectionError(
            f"a merge takes two datasets or more, got {len(opened)}, and as many names or none"
        )
    deciding = None
    if split_from is not None:
        deciding = split_from if isinstance(split_from, Dataset) else open_dataset(split_from)
    plan = plan_merge(
        opened,
        names=names or (),
        split_from=None if deciding is None else deciding.manifest.digest,
        label=label,
    )
    target = Path(out)
    if dry_run:
        check_out(target, plan.derivation)
        return summary(plan, target, root=None)
    return summary(plan, target, root=carry_out(plan, target, progress).root)


MERGE = "merge"


@dataclass(frozen=True)
class _SourceRun:
    """A run of a source, under the name that was asked for, if any."""

    source: Dataset
    run: Run
    parts: Mapping[tuple[int, int], PartEntry]
    asked: str | None

    @property
    def definition(self) -> str:
        """Digest of what makes two runs the same run: how their parts came to be."""
        settings = self.run.recipe.unit_settings() if self.run.recipe else None
        return digest([self.run.kind, self.run.seed, settings, self.run.origin, self.asked])

    @property
    def content(self) -> str:
        """Digest of keys and ids."""
        return digest([[*key, entry.id] for key, entry in sorted(self.parts.items())])


@dataclass
class _MergedRun:
    """A run of the union: one run, as several sources have parts of it."""

    members: list[_SourceRun]
    parts: dict[tuple[int, int], tuple[Dataset, PartKey, str]] = field(default_factory=dict)

    def takes(self, other: _SourceRun) -> bool:
        """Whether a run of a source is this one: made in the same way, and no key with another id."""
        return (
            other.definition == self.members[0].definition
            and all(
                self.parts[key][2] == other.parts[key].id for key in self.parts.keys() & other.parts.keys()
            )
            and all(
                member.run.source_of(task) == other.run.source_of(task)
                for member in self.members
                for task in {task for task, _ in member.parts} & {task for task, _ in other.parts}
            )
        )

    def add(self, other: _SourceRun) -> None:
        """Takes in the parts of a source's run; those that are there stay."""
        for key, entry in other.parts.items():
            self.parts.setdefault(key, (other.source, entry.key, entry.id))

    def run(self, name: str) -> Run:
        """The run of the union."""
        runs = sorted(
            (member.run for member in self.members),
            key=lambda run: canonical_json(run.model_dump(mode="json")),
        )
        steps = runs[0].steps if len({run.steps for run in runs}) == 1 else None
        sources = sorted({pair for run in runs for pair in run.sources})
        recipe = runs[0].recipe
        if recipe is not None:
            abouts = [run.recipe.about for run in runs if run.recipe is not None]
            recipe = recipe.model_copy(update={"about": merged_about(abouts)})
        changes = {"name": name, "steps": steps, "sources": tuple(sources), "recipe": recipe}
        return runs[0].model_copy(update=changes)


def plan_merge(
    sources: Sequence[Dataset],
    *,
    names: Sequence[str | None],
    split_from: str | None,
    label: str | None,
) -> Plan:
    """The union of datasets, as `merge_datasets` is told.

    Args:
        names: of each source's run `main`; further runs get the name and their own.
        split_from: digest of the source whose splits decide.
    """
    pairs = list(zip(sources, names or [None] * len(sources), strict=True))
    pairs.sort(key=lambda pair: (pair[0].manifest.root, pair[0].manifest.digest, pair[1] or ""))
    ordered = [source for source, _ in pairs]
    _check(ordered)
    tasks, splits = _tasks(ordered, split_from)
    merged = _named(_merged(pairs))
    parts = [
        PlannedPart(PartKey(*key, name), source, source_key)
        for name, run in merged.items()
        for key, (source, source_key, _) in run.parts.items()
    ]
    digests = [source.manifest.digest for source in ordered]
    settings: dict[str, Any] = {
        "names": [name for _, name in pairs],
        "split_from": None if split_from is None else digests.index(split_from),
    }
    keys = [part.key for part in parts]
    return Plan(
        runs=settle_runs([run.run(name) for name, run in merged.items()], keys, tasks),
        tasks=tasks,
        parts=tuple(sorted(parts, key=lambda part: part.key)),
        derivation=derivation_of(MERGE, settings, ordered, splits=splits),
        sources=tuple(ordered),
        label=label,
    )


def _check(sources: Sequence[Dataset]) -> None:
    first = sources[0]
    for source in sources:
        if not source.manifest.complete:
            raise SelectionError(f"{source.path} is incomplete; finish it with `tcmrl-data build` first")
        found = {name: _common(dataset) for name, dataset in (("left", first), ("right", source))}
        for name, left, right in differences(found["left"], found["right"]):
            raise SelectionError(
                f"{name} differs: {left} in {first.path} and {right} in {source.path}; only datasets of one "
                "environment and one set of tasks can be merged"
            )


def _common(source: Dataset) -> dict[str, Any]:
    environment = source.manifest.recipe.environment.model_dump(mode="json")
    return {"environment": environment, "data_version": source.manifest.data_version}


def _tasks(sources: Sequence[Dataset], split_from: str | None) -> tuple[tuple[Task, ...], dict[int, Split]]:
    """The tasks of the union, and the splits among them that no recipe has drawn."""
    if split_from is not None:
        deciding = [source for source in sources if source.manifest.digest == split_from]
        if not deciding:
            raise SelectionError("--split-from: names none of the datasets that are merged")
        sources = [deciding[0], *(source for source in sources if source is not deciding[0])]
    found: dict[int, tuple[Task, Dataset]] = {}
    splits: dict[int, Split] = {}
    for place, source in enumerate(sources):
        derivation = source.manifest.derivation
        own = derivation.split_of_tasks() if derivation else {}
        for task in source.tasks:
            known, owner = found.setdefault(task.index, (task, source))
            for name, left, right in differences(dict(known.parameters), dict(task.parameters)):
                raise SelectionError(
                    f"task {task.index}: {name} differs: {left} in {owner.path} and {right} in {source.path}"
                )
            decided = split_from is not None and owner is sources[0]
            if known.split != task.split and not decided:
                raise SelectionError(
                    f"task {task.index} is a {known.split} task in {owner.path} and a {task.split} task in "
                    f"{source.path}; say with --split-from whose split counts"
                )
            if task.index in own and (not decided or place == 0):
                splits[task.index] = own[task.index]
    return tuple(task for _, (task, _) in sorted(found.items())), splits


def _merged(pairs: Sequence[tuple[Dataset, str | None]]) -> list[_MergedRun]:
    members = []
    for source, asked in pairs:
        parts: dict[str, dict[tuple[int, int], PartEntry]] = {run.name: {} for run in source.manifest.runs}
        for entry in source.parts.entries():
            parts[entry.run][entry.task, entry.step] = entry
        for run in source.manifest.runs:
            name = asked if asked is None or run.name == MAIN_RUN else f"{asked}-{run.name}"
            members += [_SourceRun(source, run, parts[run.name], name)] if parts[run.name] else []
    merged: list[_MergedRun] = []
    for member in sorted(members, key=lambda member: (member.definition, member.content)):
        home = next((run for run in merged if run.takes(member)), None)
        if home is None:
            home = _MergedRun([])
            merged.append(home)
        home.members.append(member)
        home.add(member)
    return sorted(merged, key=_rank)


def _rank(merged: _MergedRun) -> tuple[bool, bool, int, str, str, str]:
    """Built runs before others, by seed: the first ones keep their names."""
    first = merged.members[0]
    seed = first.run.seed
    return (
        first.run.recipe is None,
        seed is None,
        seed or 0,
        first.run.kind,
        first.definition,
        first.content,
    )


def _named(merged: Sequence[_MergedRun]) -> dict[str, _MergedRun]:
    named: dict[str, _MergedRun] = {}
    for run in sorted(merged, key=lambda run: run.members[0].asked is None):
        name = run.members[0].asked
        if name is None:
            name = next(candidate for candidate in _candidates(run) if candidate not in named)
        if name in named or not re.fullmatch(RUN_NAME, name):
            why = "two different runs would have it" if name in named else "a-z, 0-9, _ and - are possible"
            raise SelectionError(f"--as: {name!r} cannot be the name of a run: {why}")
        named[name] = run
    return named


def _candidates(merged: _MergedRun) -> Iterator[str]:
    names = {member.run.name for member in merged.members}
    yield from sorted(names, key=lambda name: (name != MAIN_RUN, name))
    first = merged.members[0]
    if first.run.seed is not None:
        yield f"seed{first.run.seed}"[:64]
    yield first.run.kind
    content = first.content
    yield from (f"run-{content[:length]}" for length in range(8, 61))
