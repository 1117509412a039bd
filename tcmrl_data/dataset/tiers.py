"""Quality tiers by D4RL's words, from stored returns against stored reference returns.

The score of a part is 100 · (mean − uniform) / (best − uniform), where `best` is the task's oracle, else its
scripted expert, else its best snapshot: 0 is as good as uniform actions, 100 as the best that is known.
In datasets of several runs a tier takes its snapshots from every run.
"""

import itertools
from collections.abc import Sequence
from typing import Literal, get_args

from tcmrl_data.dataset.tables import Tables
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.part_table import PartEntry

Tier = Literal["random", "medium", "medium-replay", "expert", "medium-expert", "random-expert", "mixed"]
TIERS: tuple[Tier, ...] = get_args(Tier)

MEDIUM_SCORE = 33.0
"""D4RL's medium policies reach about a third of the expert's performance (arXiv 2004.07219, section 4)."""


def tier_parts(dataset: Tables, task: int, tier: str) -> list[PartKey]:
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


def task_scores(dataset: Tables, task: int) -> dict[PartKey, float]:
    """The scores of a task's parts, in percent, ascending by key.

    Raises:
        SelectionError: a part has no reference returns, or none above uniform actions.
    """
    entries = dataset.parts.entries_of(task)
    best = max((entry.mean for entry in entries), default=0.0)
    return {entry.key: _score(entry, best, f"{dataset.path}: {entry.key}") for entry in entries}


def medium_scores(dataset: Tables, tasks: Sequence[int]) -> dict[PartKey, float]:
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
