"""Which parts and episodes of a dataset a subset takes."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.selection import MEDIUM_SCORE, task_scores
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.seeding import Purpose, keyed_generator
from tcmrl_data.operations.assembly import Plan, PlannedPart, derivation_of, settle_runs
from tcmrl_data.parts.own_operations import SUBSET, Cut
from tcmrl_data.store.part import STANDARD_ARRAYS
from tcmrl_data.store.tables import PartKey

MAX_RECORDED_TASKS = 5_000
"""Scores of more tasks are not recorded, so that the manifest stays small; `task_scores` gives them."""

_SHARE = re.compile(r"(\d{1,3}(?:\.\d+)?)%")


@dataclass(frozen=True)
class Choice:
    """What a subset takes of a dataset; nothing is left out by default.

    Attributes:
        snapshots: a rule of `Dataset.select`.
        tasks: indices.
        split: only tasks of this split.
        episodes: of each part, a number or a share such as `50%`.
        seed: draws the episodes; None takes the first.
        min_return: only episodes whose undiscounted return reaches it.
        drop_arrays: extra arrays that are left out.
        held_out: chosen tasks that become its test tasks, and all others its training tasks; empty leaves
            splits as they are.
    """

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

    @classmethod
    def from_json(cls, settings: dict[str, Any]) -> "Choice":
        """The inverse of `to_json`; further settings are left aside.

        Raises:
            KeyError, TypeError, SelectionError: settings of another form.
        """
        settings = {"held_out": (), **settings}
        values = {name: settings[name] for name in cls.__dataclass_fields__}
        tasks = values["tasks"]
        lists = {
            "tasks": None if tasks is None else tuple(tasks),
            "drop_arrays": tuple(values["drop_arrays"]),
            "held_out": tuple(values["held_out"]),
        }
        return cls(**values | lists)


def plan_subset(source: Dataset, choice: Choice, *, label: str | None = None) -> Plan:
    """The dataset of a choice.

    Raises:
        SelectionError: nothing is left of a task, a part has fewer episodes than are asked for, or an array
            cannot be left out.
        TaskError: an index that the dataset does not hold.
        StoreError: a part whose returns are needed is damaged.
    """
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
        name=source.name,
        data_version=source.manifest.data_version,
        runs=settle_runs(source.manifest.runs, [part.key for part in parts], tasks, cut=cut_runs),
        tasks=tasks,
        parts=tuple(parts),
        derivation=derivation_of(SUBSET, settings, [source], splits=splits),
        sources=(source,),
        label=label,
    )


def _with_held_out(source: Dataset, tasks: Sequence[Task], held_out: Sequence[int]) -> tuple[Task, ...]:
    """The tasks with the splits that held-out ones give them."""
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
    """The episodes that a choice keeps of a part."""
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
    """The share that `episodes` names; None where it names a number or nothing.

    Raises:
        SelectionError: neither a number of at least 1 nor a share in (0, 100] percent.
    """
    match = _SHARE.fullmatch(episodes) if isinstance(episodes, str) else None
    if match and 0 < float(match[1]) <= 100:
        return float(match[1]) / 100
    if episodes is None or (isinstance(episodes, int) and episodes >= 1):
        return None
    raise SelectionError(f"episodes {episodes!r}: expected a number of at least 1, or a share such as 50%")


def _number(episodes: int | str | None, present: int, place: str) -> int | None:
    """How many episodes of a part to keep."""
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
        found["scores"] = {str(task): list(_ladders(source, task)) for task in tasks}
    return found


def _ladders(source: Dataset, task: int) -> Iterator[list[Any]]:
    """Run, step and score of every part of a task."""
    for key, score in task_scores(source, task).items():
        yield [key.run, key.step, round(score, 4)]
