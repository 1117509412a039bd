"""The report on a dataset: one HTML file, to be read in a browser or printed."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import summarize_returns
from tcmrl_data.describe.card import tier_rows
from tcmrl_data.describe.measures import Content, StageProgress, measure
from tcmrl_data.foundation.disk import make_folders, replace_file
from tcmrl_data.foundation.errors import RenderingError
from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.page import cell_text, render_page
from tcmrl_data.quality.worth import context_worth

EPISODES = 20
"""Whole episodes of a report."""

ALWAYS_DRAWN = 9
"""Figures of every report."""

LISTED_TASKS = 1000
"""Tasks of the table of tasks; `inspect tasks` prints all."""

LONGEST_JSON = 200
"""Characters of a task's parameters, and of a run's origin."""

REFERENCES = ("uniform", "oracle", "scripted", "behavior")

_FOLDER = Path(__file__).parent


def report_dataset(
    dataset: Dataset,
    out: str | Path,
    *,
    episodes: int = EPISODES,
    transfer: bool = False,
    progress: StageProgress | None = None,
) -> Path:
    """Writes the report on a dataset and returns its file.

    The dataset is read part by part; memory does not grow with the number of parts. Needs the extra `report`.

    Args:
        dataset: the dataset; of an incomplete one, what is there.
        transfer: let every last policy play in every task, and say what a context is worth; takes longer.
        progress: called with the stage, the amount done and the total.

    Raises:
        RenderingError: plotly is not installed.
        SelectionError: the dataset has no parts, or too few tasks for `transfer`.
        SnapshotError: a policy for `transfer` is missing.
        StoreError: a part is missing or damaged.

    Example:
        >>> report_dataset(open_dataset("data/point-robot"), "report.html")  # doctest: +SKIP
    """
    _plotly_script()
    content = measure(dataset, browsed=episodes, transfer=transfer, progress=progress)
    out = Path(out)
    make_folders(out.parent)
    replace_file(out, report_html(content, progress).encode())
    return out


def report_html(content: Content, progress: StageProgress | None = None) -> str:
    """The page of a report.

    Args:
        progress: called after every figure, which takes longer than reading a small dataset.
    """
    scripts = [_plotly_script(), (_FOLDER / "report.js").read_text(encoding="utf-8")]
    from tcmrl_data.describe import figures

    manifest = content.dataset.manifest
    title = f"{printable(manifest.label or manifest.name)}: what is in the dataset"
    returns = summarize_returns(content.returns)
    columns = ["step", "split", "tasks", "episodes", "mean", "std", "min", "max", "success_rate"]
    columns = columns if any(row["success_rate"] is not None for row in returns) else columns[:-1]
    is_scored = any(task.snapshots and task.snapshots[0].tq is not None for task in content.quality.tasks)
    has_overlap = len(content.coverage.overlap.tasks) > 1
    num_figures = ALWAYS_DRAWN + is_scored + has_overlap + (content.transfer is not None)
    drawn = itertools.count(1)

    def count_figure() -> str:
        if progress is not None:
            progress("drawing", next(drawn), num_figures)
        return ""

    differences = ("parameter", "train", "test", "difference", "standardized")
    values = {
        "content": content,
        "figures": figures,
        "verdicts": judge(content),
        "return_columns": columns,
        "return_rows": [[row[column] for column in columns] for row in returns],
        "is_scored": is_scored,
        "has_overlap": has_overlap,
        "count_figure": count_figure,
        "tier_rows": list(tier_rows(content.quality)),
        "ending_rows": list(_ending_rows(content)),
        "shift_rows": [[row[name] for name in differences] for row in content.tasks["shift"]],
        "task_rows": [_task_row(row) for row in content.tasks["tasks"][:LISTED_TASKS]],
        "provenance": list(_provenance(content)),
        "run_rows": list(_run_rows(content)),
        "recipe": json.dumps(manifest.recipe.model_dump(mode="json"), indent=2, ensure_ascii=False),
    }
    return render_page("report.html.jinja", _FOLDER, title=title, scripts=scripts, values=values)


def _plotly_script() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise RenderingError(
            f"a report needs a package that is missing ({error}); pip install 'tcmrl[report]'"
        ) from None
    return str(get_plotlyjs())


def _ending_rows(content: Content) -> Iterator[tuple[Any, ...]]:
    for step, found in sorted(content.endings.by_step.items()):
        lengths = (found.shortest, found.steps / found.episodes, found.longest)
        saturated = content.actions.saturated_share(step)
        yield step, found.episodes, *lengths, found.terminated, found.truncated, saturated


def _task_row(row: dict[str, Any]) -> tuple[Any, ...]:
    """A task with its reference returns and parameters: the numbers of `inspect tasks`."""
    rounded = {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in row["parameters"].items()
    }
    references = row["references"] or {}
    parameters = _json(rounded).removeprefix("{").removesuffix("}")
    return row["task"], row["split"], *map(references.get, REFERENCES), parameters


def _run_rows(content: Content) -> Iterator[tuple[str, ...]]:
    for run in content.dataset.manifest.runs:
        steps = "–" if run.steps is None else ", ".join(f"{step:,}" for step in run.steps)
        yield run.name, run.kind, "–" if run.seed is None else str(run.seed), steps, _json(run.origin)


def _provenance(content: Content) -> Iterator[tuple[str, str]]:
    manifest, summary = content.dataset.manifest, content.summary
    yield "dataset", printable(str(content.dataset.path))
    if manifest.label:
        yield "label", printable(manifest.label)
    yield "environment", f"{summary['name']}: {summary['description']}"
    yield "recipe", f"profile {summary['profile']}, behavior {summary['behavior']}, seed {summary['seed']}"
    yield "root", summary["root"]
    yield "digest of the manifest", manifest.digest
    yield "size", size(summary["bytes"])
    yield "schema and data version", f"{manifest.schema_version}, {manifest.data_version}"
    if manifest.derivation is not None:
        made = manifest.derivation
        yield "derived by", f"{made.operation} {_json(made.settings)} with tcmrl {made.package}"
        for source in made.sources:
            yield "derived from", f"{source.label or 'a dataset without a label'}, root {source.root}"
    for name, values in summary["made_with"].items():
        for value in values:
            yield name, value


def _json(value: Any) -> str:
    text = "–" if value is None else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= LONGEST_JSON else f"{text[:LONGEST_JSON]}…"


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
