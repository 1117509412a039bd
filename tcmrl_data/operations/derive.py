"""Deriving: a selection of a dataset becomes a dataset or a view; and a dataset's own name."""

import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.dataset.selection import (
    MEDIUM_SCORE,
    VIEW_SCHEMA,
    ViewedParts,
    is_view_file,
    medium_scores,
    task_scores,
)
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.foundation.disk import LOCK, lock_file, replace_file
from tcmrl_data.foundation.errors import SelectionError, StoreError
from tcmrl_data.foundation.records import hidden_text, parse_json, sealed, write_ranges
from tcmrl_data.foundation.seeding import Purpose, keyed_generator
from tcmrl_data.operations.assembly import (
    Plan,
    PlannedPart,
    Progress,
    carry_out,
    check_out,
    derivation_of,
    settle_runs,
)
from tcmrl_data.parts.own_operations import SUBSET, Cut
from tcmrl_data.store.manifest import (
    MANIFEST,
    Manifest,
    dataset_folder,
    read_manifest,
    totals_of,
    write_manifest,
)
from tcmrl_data.store.part import STANDARD_ARRAYS
from tcmrl_data.store.tables import PartKey

TOLERANCE = 15.0
"""A medium snapshot whose score is further from 33 than this is hardly medium: 18 to 48 are near."""


@dataclass(frozen=True)
class Derived:
    """What a derivation made, or would make.

    Attributes:
        cut: number of parts among them that were made anew.
        bytes: size of the archives; before parts are cut, that of the whole parts.
        root: None where it is not known, as before parts are cut.
        far_from_medium: scores of medium snapshots that are not near 33, by the text of their keys.
    """

    out: Path
    parts: int
    cut: int
    bytes: int
    tasks: int
    test_tasks: tuple[int, ...]
    steps: tuple[int, ...]
    label: str | None
    root: str | None
    sources: tuple[str, ...]
    far_from_medium: dict[str, float]


def derive_dataset(
    source: str | Path | Dataset,
    out: str | Path | None = None,
    *,
    view: str | Path | None = None,
    tier: str | None = None,
    snapshots: str = "all",
    tasks: Sequence[int] | None = None,
    split: Split | None = None,
    held_out: Sequence[int] = (),
    episodes: int | str | None = None,
    seed: int | None = None,
    min_return: float | None = None,
    drop_arrays: Sequence[str] = (),
    label: str | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Derived:
    """Makes a dataset, or a view, of some parts and episodes of another.

    Whole parts keep their ids and their bytes. Parts that lose episodes or arrays are made anew and name the
    part that they were cut from. The same call, made again after an interruption, goes on.

    Args:
        view: file of the new view instead, which names parts and copies nothing.
        tier: a quality tier, such as `medium`; `TIERS` lists them.
        snapshots: a rule of `Dataset.select`, instead of a tier.
        held_out: chosen tasks that become the test tasks, and all others the training tasks; such as some
            training tasks on which settings are compared, while the test tasks are left out.
        episodes: of each part, a number or a share such as `50%`.
        seed: draws the episodes; None takes the first.
        min_return: only episodes whose undiscounted return reaches it; parts without one are left out.
        drop_arrays: extra arrays, such as `success`, that are left out.

    Raises:
        SelectionError: the choice cannot be read, contradicts itself, or leaves nothing of a task.
        TaskError: an index that the dataset does not hold.
        StoreError: `out` or `view` exists, or a part is damaged, or the source has changed meanwhile.
        StorageError: the operating system refuses an operation.
        LockedError: another process writes to `out`.

    Example:
        >>> derive_dataset("data/point-robot", "data/point-robot-medium", tier="medium")  # doctest: +SKIP
    """
    opened = source if isinstance(source, Dataset) else open_dataset(source)
    check_label(label)
    if (out is None) == (view is None):
        raise SelectionError("a derivation makes a dataset (--out) or a view (--view); name one of the two")
    if tier is not None and snapshots != "all":
        raise SelectionError(f"snapshots {snapshots!r} and tier {tier!r} exclude each other; name one")
    rule = snapshots if tier is None else f"tier:{tier}"
    indices = None if tasks is None else tuple(tasks)
    choice = Choice(rule, indices, split, episodes, seed, min_return, tuple(drop_arrays), tuple(held_out))
    plan = plan_subset(opened, choice, label=label)
    target = Path(out if out is not None else view or "")
    root = None
    if view is not None and plan.num_cut:
        raise SelectionError(
            "--view: a view names whole parts; use --out for parts that lose episodes or arrays"
        )
    if view is not None and not dry_run:
        root = write_view(plan, target)
    elif not dry_run:
        root = carry_out(plan, target, progress).root
    elif view is None:
        check_out(target, plan.derivation)
    return summary(plan, target, root=root, far=_far_from_medium(plan, rule))


def summary(plan: Plan, out: Path, *, root: str | None, far: dict[str, float] | None = None) -> Derived:
    """What is said of a planned or made dataset."""
    size = sum(part.source.entry(part.source_key).size for part in plan.parts)
    return Derived(
        out=out,
        parts=len(plan.parts),
        cut=plan.num_cut,
        bytes=size if root is None or out.is_file() else read_manifest(out).totals.bytes,
        tasks=len(plan.tasks),
        test_tasks=tuple(task.index for task in plan.tasks if task.split == "test"),
        steps=tuple(sorted({part.key.step for part in plan.parts})),
        label=plan.label,
        root=root,
        sources=tuple(source.root for source in plan.derivation.sources),
        far_from_medium=far or {},
    )


def describe_far(far: dict[str, float]) -> str:
    """The first medium snapshots that are not near 33, in words."""
    named = [f"{key} has {score:.0f}" for key, score in list(far.items())[:3]]
    more = f", and {len(far) - 3} more" if len(far) > 3 else ""
    return "; ".join(named) + more


def _far_from_medium(plan: Plan, rule: str) -> dict[str, float]:
    if "medium" not in rule:
        return {}
    (source,) = plan.sources
    scores = medium_scores(source, [task.index for task in plan.tasks])
    return {str(key): score for key, score in scores.items() if abs(score - MEDIUM_SCORE) > TOLERANCE}


def write_view(plan: Plan, file: Path) -> str:
    """Writes the view of the whole parts of a plan's one source; returns its root.

    Raises:
        StoreError: the file exists, its name is none for a view, or the view would be too large.
    """
    (source,) = plan.sources
    if not is_view_file(file):
        raise StoreError(f"--view {file}: a view is a file whose name ends in .json, and is not {MANIFEST}")
    if os.path.lexists(file):
        raise StoreError(f"--view {file} exists; choose another name or remove it")
    folder = source.path_on_disk if source.remote else source.folder
    chosen = {part.key for part in plan.parts}
    table = source.parts.only(chosen)
    fields = {
        "schema_version": VIEW_SCHEMA,
        "source": os.path.relpath(folder.resolve(), file.parent.resolve()),
        "source_root": source.sealed_root,
        "label": plan.label,
        "derivation": plan.derivation.model_dump(mode="json"),
        "totals": totals_of(table).model_dump(),
        "root": table.root,
        "parts": [group.model_dump(mode="json") for group in _groups(chosen)],
    }
    data = sealed(fields)
    try:
        parse_json(data)
    except ValueError as error:
        raise StoreError(f"--view {file}: too many parts for a view ({error}); use --out instead") from None
    replace_file(file, data)
    return table.root


def _groups(keys: set[PartKey]) -> Iterator[ViewedParts]:
    steps: dict[tuple[str, int], list[int]] = {}
    for key in sorted(keys):
        steps.setdefault((key.run, key.task), []).append(key.step)
    tasks: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for (run, task), members in steps.items():
        tasks.setdefault((run, tuple(members)), []).append(task)
    for (run, common), alike in sorted(tasks.items()):
        yield ViewedParts(tasks=write_ranges(alike), steps=common, run=run)


LONGEST_LABEL = 200


def rename_dataset(path: str | Path, label: str) -> Manifest:
    """Gives a dataset another label; its digest changes, its root does not, and its folder stays.

    Returns:
        The new manifest.

    Raises:
        SelectionError: the label is empty, too long, or holds control characters.
        ManifestError: there is no dataset at the path.
        LockedError: another process works on the dataset.
        ReadOnlyError: the folder cannot be written.

    Example:
        >>> rename_dataset("data/pr-two-seeds", "pr/two-seeds")  # doctest: +SKIP
    """
    check_label(label)
    folder = dataset_folder(path)
    read_manifest(folder)
    with lock_file(folder / LOCK, f"dataset {folder}"):
        fields = read_manifest(folder).model_dump(mode="json", exclude={"digest"})
        write_manifest(folder, sealed(fields | {"label": label}))
        return read_manifest(folder)


def check_label(label: str | None) -> None:
    """Refuses a label that no manifest may hold."""
    if label is not None and (
        not label.strip() or len(label) > LONGEST_LABEL or "\n" in label or hidden_text(label, "label")
    ):
        raise SelectionError(
            f"label {label[:40]!r}: expected 1 to {LONGEST_LABEL} characters that can be printed on a line"
        )


MAX_RECORDED_TASKS = 5_000
"""Scores of more tasks are not recorded, so that the manifest stays small; `task_scores` gives them."""

_SHARE = re.compile(r"(\d{1,3}(?:\.\d+)?)%")


@dataclass(frozen=True)
class Choice:
    """What a subset takes of a dataset, as `derive_dataset` is told; nothing is left out by default."""

    snapshots: str = "all"
    tasks: tuple[int, ...] | None = None
    split: Split | None = None
    episodes: int | str | None = None
    seed: int | None = None
    min_return: float | None = None
    drop_arrays: tuple[str, ...] = ()
    held_out: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _share(self.episodes)
        if self.seed is not None and (self.episodes is None or self.seed < 0):
            raise SelectionError(f"seed {self.seed}: a seed of at least 0 draws episodes; say how many")
        if self.min_return is not None and not math.isfinite(self.min_return):
            raise SelectionError(f"min_return {self.min_return} is no return")

    def to_json(self) -> dict[str, Any]:
        """The choice as a derivation records it; without held-out tasks as it was before there were any."""
        tasks = None if self.tasks is None else sorted(set(self.tasks))
        values = vars(self) | {"tasks": tasks, "drop_arrays": sorted(set(self.drop_arrays))}
        del values["held_out"]
        return values | ({"held_out": sorted(set(self.held_out))} if self.held_out else {})


def plan_subset(source: Dataset, choice: Choice, *, label: str | None = None) -> Plan:
    """The dataset of a choice; errors as of `derive_dataset`."""
    selection = source.select(split=choice.split, tasks=choice.tasks, snapshots=choice.snapshots)
    tasks = _with_held_out(source, sorted(selection.tasks, key=lambda task: task.index), choice.held_out)
    splits = {task.index: task.split for task in tasks} if choice.held_out else None
    parts: list[PlannedPart] = []
    for task in tasks:
        kept = [
            PlannedPart(key, source, key, _cut(positions, source.entry(key).episodes, choice))
            for key in selection.parts[task.index]
            if (positions := _positions(source, key, choice))
        ]
        if not kept:
            raise SelectionError(
                f"{source.path}: no episode of task {task.index} has a return of {choice.min_return:g}; "
                "leave the task out with --tasks"
            )
        parts += kept
    _check_arrays(source, parts, choice.drop_arrays)
    cut_runs = {part.key.run for part in parts if part.operation}
    settings = choice.to_json() | _scores(source, choice.snapshots, [task.index for task in tasks])
    return Plan(
        runs=settle_runs(source.manifest.runs, [part.key for part in parts], tasks, cut=cut_runs),
        tasks=tasks,
        parts=tuple(parts),
        derivation=derivation_of(SUBSET, settings, [source], splits=splits),
        sources=(source,),
        label=label,
    )


def _with_held_out(source: Dataset, tasks: Sequence[Task], held_out: Sequence[int]) -> tuple[Task, ...]:
    if not held_out:
        return tuple(tasks)
    known = [task.index for task in tasks]
    missing = sorted(set(held_out) - set(known))
    if missing or not set(known) - set(held_out):
        problem = f"does not choose task {missing[0]}" if missing else "leaves no training task"
        raise SelectionError(
            f"{source.path}: held-out tasks {list(held_out)}: the selection {problem}; it has tasks {known}"
        )
    return tuple(replace(task, split="test" if task.index in held_out else "train") for task in tasks)


def _cut(positions: Sequence[int], present: int, choice: Choice) -> Cut | None:
    """The operation that keeps some episodes and arrays; None where all are kept."""
    if len(positions) == present and not choice.drop_arrays:
        return None
    return Cut.of(None if len(positions) == present else positions, without=set(choice.drop_arrays))


def _positions(source: Dataset, key: PartKey, choice: Choice) -> Sequence[int]:
    entry = source.entry(key)
    positions: Sequence[int] = range(entry.episodes)
    if choice.min_return is not None and entry.min < choice.min_return:
        positions = []
        if entry.max >= choice.min_return:
            positions = [
                position
                for position, episode in enumerate(source.trajectories(*key))
                if episode.undiscounted_return >= choice.min_return
            ]
        if not positions:
            return positions
    number = _number(choice.episodes, entry.episodes, f"{source.path}: {key}")
    if number is not None and number < len(positions):
        positions = (
            positions[:number] if choice.seed is None else _draw(source, key, positions, number, choice.seed)
        )
    return positions


def _draw(source: Dataset, key: PartKey, positions: Sequence[int], number: int, seed: int) -> list[int]:
    generator = keyed_generator(seed, source.name, key.task, Purpose.SUBSET, key.step)
    return sorted(np.array(positions)[generator.permutation(len(positions))[:number]].tolist())


def _share(episodes: int | str | None) -> float | None:
    """The share that `episodes` names; None where it names a number or nothing."""
    match = _SHARE.fullmatch(episodes) if isinstance(episodes, str) else None
    if match and 0 < float(match[1]) <= 100:
        return float(match[1]) / 100
    if episodes is None or (isinstance(episodes, int) and episodes >= 1):
        return None
    raise SelectionError(f"episodes {episodes!r}: expected a number of at least 1, or a share such as 50%")


def _number(episodes: int | str | None, present: int, place: str) -> int | None:
    share = _share(episodes)
    if share is not None:
        return max(1, round(share * present))
    if isinstance(episodes, int) and episodes > present:
        raise SelectionError(f"{place} has {present} episodes, not the {episodes} that are asked for")
    return episodes if isinstance(episodes, int) else None


def _check_arrays(source: Dataset, parts: Sequence[PlannedPart], names: Sequence[str]) -> None:
    """Refuses arrays that are not there, by the first part of every run."""
    firsts = {part.source_key.run: part.source_key for part in reversed(parts)} if names else {}
    for key in firsts.values():
        extras = set(source.part(*key).identity.arrays) - set(STANDARD_ARRAYS)
        for name in sorted(set(names) - extras):
            known = ", ".join(sorted(extras)) or "none"
            raise SelectionError(
                f"{source.file_of(key)}: array {name!r} cannot be left out; its extra arrays are: {known}"
            )


def _scores(source: Dataset, rule: str, tasks: Sequence[int]) -> dict[str, Any]:
    """What a derivation records of a tier: its threshold, and the steps and scores that it chose from."""
    tier = rule.replace(" ", "").partition("tier:")[2]
    if tier in ("", "mixed", "random"):
        return {}
    found: dict[str, Any] = {"medium_score": MEDIUM_SCORE}
    if len(tasks) <= MAX_RECORDED_TASKS:
        found["scores"] = {
            str(task): [
                [key.run, key.step, round(score, 4)] for key, score in task_scores(source, task).items()
            ]
            for task in tasks
        }
    return found
