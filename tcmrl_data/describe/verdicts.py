"""The first screen of a report: what a reader should know before using the dataset, each with its number."""

from dataclasses import dataclass
from statistics import fmean
from typing import Any, Literal

import numpy as np

from tcmrl_data.describe.measures import Content
from tcmrl_data.foundation.page import cell_text
from tcmrl_data.quality.worth import context_worth

Tone = Literal["good", "note", "plain"]

SATURATION_NOTED = 0.5
"""Share of saturated action values from which a reader is warned."""

SILENCE_NOTED = 0.5
"""Share of zero rewards, or of episodes without reward, from which a reader is warned."""

WORTH_NOTED = 0.1
"""Worth of a context below which a reader is warned."""

SHIFT_NOTED = 0.5
"""Difference of training and test tasks, in standard deviations, from which a reader is warned."""


@dataclass(frozen=True)
class Verdict:
    """A statement about a dataset, with the numbers that it follows from.

    The tone says whether it speaks for the dataset, asks for attention, or is a fact.
    """

    tone: Tone
    statement: str
    evidence: str

    @property
    def mark(self) -> str:
        """The tone in a word."""
        return "fact" if self.tone == "plain" else self.tone


def judge(content: Content) -> list[Verdict]:
    """The verdicts on a dataset, most important first."""
    found = (
        _completeness(content),
        _learning(content),
        _rewards(content),
        _overlap(content),
        _worth(content),
        _endings(content),
        _saturation(content),
        _shift(content),
    )
    return [verdict for verdict in found if verdict is not None]


def _completeness(content: Content) -> Verdict:
    summary = content.summary
    counts = f"{summary['parts']:,} of {summary['parts_total']:,} parts with {summary['episodes']:,} episodes"
    tasks = f"{summary['train']:,} training and {summary['test']:,} test tasks"
    size = f"{counts} and {summary['steps']:,} steps; {tasks}."
    if summary["complete"]:
        return Verdict("good", "Complete", size)
    return Verdict("note", "Incomplete", f"{size} Run its `tcmrl-data build` command again.")


def _learning(content: Content) -> Verdict | None:
    """Whether the last snapshots are better than the first ones."""
    ladders = [task["snapshots"] for task in content.returns["tasks"] if len(task["snapshots"]) > 1]
    if not ladders:
        return None
    better = sum(ladder[-1]["mean"] > ladder[0]["mean"] for ladder in ladders)
    first, last = (sum(ladder[place]["mean"] for ladder in ladders) / len(ladders) for place in (0, -1))
    evidence = (
        f"The last snapshot is better than the first in {better:,} of {len(ladders):,} tasks; "
        f"the mean return goes from {cell_text(first)} to {cell_text(last)}."
    )
    if better == len(ladders):
        return Verdict("good", "Every behavior policy learned", evidence)
    return Verdict("note", f"{len(ladders) - better:,} behavior policies did not learn", evidence)


def _rewards(content: Content) -> Verdict:
    """Whether rewards are seen from the first snapshots on."""
    stages = content.rewards.stages
    first, last = ([stage for stage in stages if stage.step == stages[place].step] for place in (0, -1))
    zero, silent = (fmean(getattr(stage, name) for stage in first) for name in ("zero", "silent"))
    later_zero, later_silent = (fmean(getattr(stage, name) for stage in last) for name in ("zero", "silent"))
    evidence = (
        f"{zero:.0%} of the rewards at step {first[0].step:,} are zero, {later_zero:.0%} at step "
        f"{last[0].step:,}; {silent:.0%} and {later_silent:.0%} of the episodes have no reward at all."
    )
    if silent >= SILENCE_NOTED:
        return Verdict("note", "Early snapshots see hardly any reward", evidence)
    if zero >= SILENCE_NOTED:
        return Verdict("note", "Rewards are sparse", evidence)
    return Verdict("good", "Rewards are seen at every stage", evidence)


def _overlap(content: Content) -> Verdict | None:
    """How much of their states tasks share."""
    shares = np.array(content.coverage.overlap.shares)
    if len(shares) < 2:
        return None
    mean = float(shares[~np.eye(len(shares), dtype=bool)].mean())
    evidence = (
        f"On average {mean:.0%} of the state cells that a task visits are visited by another task too, "
        f"over {len(shares)} tasks."
    )
    return Verdict("plain", f"Tasks share {mean:.0%} of their states", evidence)


def _worth(content: Content) -> Verdict | None:
    """What a context is worth in the tasks of the test split, or of the training split without one."""
    if content.transfer is None:
        return None
    single, splits = context_worth(content.transfer)
    found = splits[-1]
    if found.worth is None:
        return None
    evidence = (
        f"In {found.tasks:,} {found.split} tasks the tasks' own last policies return {cell_text(found.own)}, "
        f"the best single policy, of task {single:,}, {cell_text(found.single)}: the difference is "
        f"{found.worth:.0%} of the range from uniform actions to the best known returns."
    )
    if found.worth >= WORTH_NOTED:
        return Verdict("good", f"A context is worth {found.worth:.0%}", evidence)
    return Verdict("note", f"A context is worth only {found.worth:.0%}", evidence)


def _endings(content: Content) -> Verdict:
    found = content.endings.by_step.values()
    episodes = sum(counts.episodes for counts in found)
    terminated = sum(counts.terminated for counts in found) / episodes
    truncated = sum(counts.truncated for counts in found) / episodes
    lengths = min(counts.shortest for counts in found), max(counts.longest for counts in found)
    length = f"{lengths[0]:,}" if lengths[0] == lengths[1] else f"{lengths[0]:,} to {lengths[1]:,}"
    evidence = (
        f"{terminated:.0%} of them are terminated by the task, {truncated:.0%} truncated by the time limit."
    )
    return Verdict("plain", f"Episodes have {length} steps", evidence)


def _saturation(content: Content) -> Verdict:
    share = {step: content.actions.saturated_share(step) for step in sorted(content.actions.counts)}
    last = list(share)[-1]
    evidence = (
        f"{share[last]:.0%} of the action values at step {last:,} have a size of at least 0.99 "
        f"(first snapshot: {next(iter(share.values())):.0%})."
    )
    if share[last] >= SATURATION_NOTED:
        return Verdict("note", "Most actions of the last snapshots are saturated", evidence)
    return Verdict("plain", "Actions are mostly inside their limits", evidence)


def _shift(content: Content) -> Verdict | None:
    rows: list[dict[str, Any]] = [row for row in content.tasks["shift"] if row["standardized"] is not None]
    if not rows:
        return None
    largest = max(rows, key=lambda row: abs(row["standardized"]))
    evidence = (
        f"{largest['parameter']}: mean {cell_text(largest['train'])} in training tasks and "
        f"{cell_text(largest['test'])} in test tasks, {largest['standardized']:+.2f} standard deviations."
    )
    if abs(largest["standardized"]) >= SHIFT_NOTED:
        return Verdict("note", "Test tasks differ from training tasks", evidence)
    return Verdict("good", "Test tasks lie among the training tasks", evidence)
