"""Some parts of a dataset: selections, quality tiers and view files.

Tiers have D4RL's words and come from stored returns against stored reference returns. The score of a part is
100 · (mean − uniform) / (best − uniform), where `best` is the task's oracle, else its scripted expert, else
its best snapshot: 0 is as good as uniform actions, 100 as the best that is known. In datasets of several runs
a tier takes its snapshots from every run.

A view file names parts of a dataset, and opens as a dataset does. It holds the path of its source relative to
itself, the source's root, and the keys of its parts. It opens only on a source with that root.
"""

import functools
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import Record, count_ranges, read_ranges
from tcmrl_data.store.manifest import MANIFEST, Derivation, Manifest, Totals, read_document
from tcmrl_data.store.part_table import PartEntry
from tcmrl_data.store.tables import MAX_STEPS, MAX_TASKS, RUN_NAME, SHA256, PartKey

if TYPE_CHECKING:
    from tcmrl_data.dataset.dataset import Dataset

_RULE = re.compile(r"all|last|steps>=(\d+)|return>=(0(?:\.\d+)?|1(?:\.0+)?)|tier:(.*)")


def chosen_parts(dataset: "Dataset", task: int, rule: str) -> tuple[PartKey, ...]:
    """Parts of a task that a rule of `Dataset.select` leaves, sorted by step and run.

    Raises:
        SelectionError: the task is incomplete, the rule cannot be read, or nothing is left.
    """
    missing = [key.step for key in dataset.missing(task)]
    if missing:
        raise SelectionError(
            f"{dataset.path}: task {task} lacks snapshots {missing}; finish it with `tcmrl-data build`"
        )
    keys = dataset.parts.keys_of(task)
    match = _RULE.fullmatch(rule.replace(" ", ""))
    if match is None:
        raise SelectionError(
            f"snapshots {rule!r}: expected all, last, steps>=N, return>=Q with Q in [0, 1], or tier:NAME"
        )
    chosen = keys
    if rule == "last":
        last = {key.run: key.step for key in keys}
        chosen = [key for key in keys if key.step == last[key.run]]
    elif match[1]:
        chosen = [key for key in keys if key.step >= int(match[1])]
    elif match[2]:
        means = {key: dataset.entry(key).mean for key in keys}
        threshold = np.quantile(list(means.values()), float(match[2]))
        chosen = [key for key in keys if means[key] >= threshold]
    elif match[3] is not None:
        chosen = tier_parts(dataset, task, match[3])
    if not chosen:
        raise SelectionError(
            f"{dataset.path}: snapshots {rule!r} leaves nothing of task {task}, "
            f"which has {[key.step for key in keys]}"
        )
    return tuple(chosen)


MOST_TASKS = 10
"""Tasks that an error lists."""


@dataclass(frozen=True)
class Selection:
    """Some tasks and snapshots of a dataset, whose episodes are not read yet.

    Attributes:
        parts: task index to the keys of its selected parts.
        allow_test: training may use parts that were made from test tasks.
        rule: by which the parts were chosen, such as `all` or `tier:medium`.
    """

    dataset: "Dataset"
    tasks: tuple[Task, ...]
    parts: dict[int, tuple[PartKey, ...]]
    allow_test: bool = False
    rule: str = "all"

    def trajectories(self, task: int) -> list[Trajectory]:
        """All selected episodes of a task, snapshot by snapshot.

        Raises:
            SelectionError: the task is not selected.
        """
        if task not in self.parts:
            held = ", ".join(map(str, [*self.parts][:MOST_TASKS]))
            raise SelectionError(f"{self.dataset.path}: task {task} is not selected; selected are {held}, …")
        return [trajectory for key in self.parts[task] for trajectory in self.dataset.trajectories(*key)]

    def parts_from_test(self) -> list[tuple[PartKey, int]]:
        """Parts made from the policy or the episodes of another task that is not for training, and it."""
        runs = {run.name: dict(run.sources) for run in self.dataset.manifest.runs}
        return [
            (key, source)
            for keys in self.parts.values()
            for key in keys
            if (source := runs[key.run].get(key.task)) is not None
            and self.dataset.split_of(source) != "train"
        ]


Tier = Literal["random", "medium", "medium-replay", "expert", "medium-expert", "random-expert", "mixed"]
TIERS: tuple[Tier, ...] = get_args(Tier)

MEDIUM_SCORE = 33.0
"""D4RL's medium policies reach about a third of the expert's performance (arXiv 2004.07219, section 4)."""


def tier_parts(dataset: "Dataset", task: int, tier: str) -> list[PartKey]:
    """The parts of a task that belong to a tier, ascending.

    `random` takes step 0; `medium` the first snapshot with a score of at least 33; `medium-replay` all up to
    and with that one; `expert` the last snapshot with the highest score; `medium-expert` and `random-expert`
    both, with equally many episodes; `mixed` all.

    Raises:
        SelectionError: no such tier, no reference returns, no part that qualifies, or halves with different
            numbers of episodes.
    """
    if tier not in TIERS:
        raise SelectionError(f"tier {tier!r} does not exist; choose one of {', '.join(TIERS)}")
    entries = dataset.parts.entries_of(task)
    if tier == "mixed":
        return [entry.key for entry in entries]
    scores = {} if tier == "random" else task_scores(dataset, task)
    runs = sorted({entry.run for entry in entries})
    ladders = [[entry for entry in entries if entry.run == run] for run in runs]
    chosen = [part for ladder in ladders for part in _of_ladder(ladder, tier, scores)]
    if not chosen:
        best = f"the best score is {max(scores.values()):.0f}" if scores else "it has no part of step 0"
        raise SelectionError(
            f"{dataset.path}: task {task} has no {tier} snapshot, {best}; leave the task out with --tasks"
        )
    if tier.endswith("-expert") and len({entry.episodes for entry in chosen}) > 1:
        found = ", ".join(f"{entry.episodes} at step {entry.step}" for entry in chosen)
        raise SelectionError(
            f"{dataset.path}: task {task} has parts with different numbers of episodes ({found}), and {tier} "
            "takes equally many; cut them with `tcmrl-data derive --episodes` first"
        )
    return sorted(entry.key for entry in chosen)


def task_scores(dataset: "Dataset", task: int) -> dict[PartKey, float]:
    """The scores of a task's parts, in percent, ascending by key.

    Raises:
        SelectionError: a part has no reference returns, or none above uniform actions.
    """
    entries = dataset.parts.entries_of(task)
    best = max((entry.mean for entry in entries), default=0.0)
    return {entry.key: _score(entry, best, f"{dataset.path}: {entry.key}") for entry in entries}


def medium_scores(dataset: "Dataset", tasks: Sequence[int]) -> dict[PartKey, float]:
    """The scores of the medium snapshots of some tasks, to be compared with `MEDIUM_SCORE`."""
    found: dict[PartKey, float] = {}
    for task in tasks:
        scores = task_scores(dataset, task)
        found |= {key: scores[key] for key in tier_parts(dataset, task, "medium")}
    return found


def _score(entry: PartEntry, best_snapshot: float, place: str) -> float:
    if entry.uniform is None:
        raise SelectionError(f"{place}: no return of uniform actions is known, so it has no score")
    known = [best for best in (entry.oracle, entry.scripted, best_snapshot) if best is not None]
    if known[0] <= entry.uniform:
        raise SelectionError(
            f"{place}: its best known return {known[0]:g} is not above that of uniform actions, "
            f"{entry.uniform:g}, so it has no score"
        )
    return 100.0 * (entry.mean - entry.uniform) / (known[0] - entry.uniform)


def _of_ladder(ladder: list[PartEntry], tier: str, scores: dict[PartKey, float]) -> list[PartEntry]:
    """The parts of one run and task that belong to a tier; none where a half is missing."""
    if tier in ("medium-expert", "random-expert"):
        halves = [_of_ladder(ladder, half, scores) for half in tier.split("-")]
        return list(dict.fromkeys(itertools.chain(*halves))) if all(halves) else []
    if tier == "random":
        return [entry for entry in ladder if entry.step == 0]
    if tier == "expert":
        return [max(ladder, key=lambda entry: (scores[entry.key], entry.step))] if ladder else []
    reached = [place for place, entry in enumerate(ladder) if scores[entry.key] >= MEDIUM_SCORE]
    if not reached:
        return []
    return ladder[: reached[0] + 1] if tier == "medium-replay" else [ladder[reached[0]]]


VIEW_SCHEMA = 1


class ViewedParts(Record):
    """Tasks of which a view takes the same snapshots.

    Attributes:
        tasks: their indices, such as `0-9,12`.
        steps: of the snapshots, ascending.
    """

    tasks: str
    steps: tuple[int, ...] = Field(min_length=1, max_length=MAX_STEPS)
    run: str = Field(pattern=rf"^{RUN_NAME}$")

    def __len__(self) -> int:
        return count_ranges(self.tasks, limit=MAX_TASKS) * len(self.steps)

    @property
    def keys(self) -> Iterator[PartKey]:
        """The parts."""
        for task in read_ranges(self.tasks, limit=MAX_TASKS):
            yield from (PartKey(task, step, self.run) for step in self.steps)


class ViewFile(Record):
    """A view file.

    Attributes:
        digest: sha256 of the canonical form of all other fields.
        source: the dataset's folder, relative to the view's.
        label: the view's own name.
        derivation: how the parts were chosen, and their splits if these are not the source's.
        root: what the root of a dataset of these parts is.
    """

    schema_version: int
    digest: str = Field(pattern=SHA256)
    source: str = Field(min_length=1, max_length=4096)
    source_root: str = Field(pattern=SHA256)
    label: str | None = Field(max_length=200)
    derivation: Derivation
    totals: Totals
    root: str = Field(pattern=SHA256)
    parts: tuple[ViewedParts, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _is_no_larger_than_a_dataset(self) -> "ViewFile":
        if sum(map(len, self.parts)) != self.totals.parts:
            raise ValueError("totals.parts is not the number of its parts")
        return self

    @functools.cached_property
    def keys(self) -> frozenset[PartKey]:
        """The parts."""
        return frozenset(key for group in self.parts for key in group.keys)

    def manifest_of(self, source: Manifest, tasks: Iterable[int]) -> Manifest:
        """The manifest of a dataset that holds the view's parts alone."""
        runs = [run.model_copy(update={"steps": None}) for run in source.runs]
        changes = {
            "digest": self.digest,
            "label": self.label,
            "derivation": self.derivation,
            "runs": tuple(runs),
            "dropped": tuple(sorted(set(tasks) - {key.task for key in self.keys})),
            "totals": self.totals,
            "root": self.root,
            "complete": True,
        }
        return source.model_copy(update=changes)


def is_view_file(path: str | Path) -> bool:
    """Whether a path can only be that of a view: its name ends in `.json` and is not the manifest's."""
    path = Path(path)
    return path.suffix == ".json" and path.name != MANIFEST and not path.is_dir()


def read_view(file: Path) -> ViewFile:
    """Reads a view file.

    Raises:
        ManifestError: it is missing, truncated, edited, or of another schema version.
    """
    missing, damaged = f"make a view with `tcmrl-data derive --view {file}`", "not a view, derive it again"
    return read_document(ViewFile, file, version=VIEW_SCHEMA, missing=missing, damaged=damaged)[1]
