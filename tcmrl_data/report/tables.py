"""Tables of a dataset's report, one per function."""

import json
from collections.abc import Iterator
from statistics import fmean
from typing import Any

from tcmrl_data.dataset.returns import summarize_returns
from tcmrl_data.dataset.selection import TIERS
from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.page.markup import Markup, details, element, table
from tcmrl_data.report.content import Content

LISTED_TASKS = 1000
"""Tasks of the table of tasks; `inspect tasks` prints all."""

PARAMETER_CHARACTERS = 200


def returns_table(content: Content) -> Markup:
    """Mean returns by snapshot and split: the numbers of `inspect returns`."""
    rows = summarize_returns(content.returns)
    columns = ["step", "split", "tasks", "episodes", "mean", "std", "min", "max", "success_rate"]
    with_success = any(row["success_rate"] is not None for row in rows)
    columns = columns if with_success else columns[:-1]
    return table(columns, ([row[column] for column in columns] for row in rows), text=["split"])


def tiers_table(content: Content) -> Markup:
    """Quality tiers: how many tasks have them, and their parts."""
    rows = []
    for tier in TIERS:
        parts = [
            (task.task, snapshot)
            for task in content.quality.tasks
            for snapshot in task.snapshots
            if tier in snapshot.tiers
        ]
        known = [snapshot.tq for _, snapshot in parts if snapshot.tq is not None]
        tasks, episodes = len({task for task, _ in parts}), sum(snapshot.episodes for _, snapshot in parts)
        rows.append((tier, tasks, len(parts), episodes, fmean(known) if known else None))
    return table(("tier", "tasks", "parts", "episodes", "mean TQ"), rows, text=["tier"])


def endings_table(content: Content) -> Markup:
    """Lengths and endings of episodes by snapshot."""
    found = content.episodes.found
    rows = []
    for step, counts in sorted(found.items()):
        lengths = (counts.shortest, counts.steps / counts.episodes, counts.longest)
        saturated = content.actions.saturated_share(step)
        rows.append((step, counts.episodes, *lengths, counts.terminated, counts.truncated, saturated))
    columns = (
        "step",
        "episodes",
        "shortest",
        "mean length",
        "longest",
        "terminated",
        "truncated",
        "saturated actions",
    )
    return table(columns, rows)


def tasks_table(content: Content) -> Markup:
    """Tasks with parameters and reference returns: the numbers of `inspect tasks`."""
    references = ("uniform", "oracle", "scripted", "behavior")
    listed = content.tasks["tasks"][:LISTED_TASKS]
    rows = [
        (
            row["task"],
            row["split"],
            *((row["references"] or {}).get(name) for name in references),
            _parameters(row),
        )
        for row in listed
    ]
    left = len(content.tasks["tasks"]) - len(listed)
    note = element("p", f"{left:,} more tasks: ", element("code", "tcmrl-data inspect tasks")) if left else ""
    inner = table(("task", "split", *references, "parameters"), rows, text=["split", "parameters"])
    return details(f"All {len(content.tasks['tasks']):,} tasks", inner, note)


def shift_table(content: Content) -> Markup | None:
    """How training and test tasks differ; None where nothing can be compared."""
    columns = ("parameter", "train", "test", "difference", "standardized")
    rows = [[row[column] for column in columns] for row in content.tasks["shift"]]
    return table(columns, rows, text=["parameter"]) if rows else None


def provenance_table(content: Content) -> Markup:
    """What the dataset is and where it comes from."""
    return table(("property", "value"), _provenance(content), text=["property", "value"])


def runs_table(content: Content) -> Markup:
    """How the parts were made."""
    rows = [
        (run.name, run.kind, "–" if run.seed is None else str(run.seed), _steps(run.steps), _json(run.origin))
        for run in content.dataset.manifest.runs
    ]
    columns = ("run", "kind", "seed", "snapshot steps", "origin")
    return table(columns, rows, text=columns)


def recipe_text(content: Content) -> Markup:
    """The recipe of the first run."""
    recipe = content.dataset.manifest.recipe.model_dump(mode="json")
    text = json.dumps(recipe, indent=2, ensure_ascii=False)
    return details("The recipe", element("pre", element("code", text)))


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
        derivation = manifest.derivation
        yield (
            "derived by",
            f"{derivation.operation} {_json(derivation.settings)} with tcmrl {derivation.package}",
        )
        for source in derivation.sources:
            yield "derived from", f"{source.label or 'a dataset without a label'}, root {source.root}"
    for name, values in summary["made_with"].items():
        for value in values:
            yield name, value


def _steps(steps: tuple[int, ...] | None) -> str:
    return "–" if steps is None else ", ".join(f"{step:,}" for step in steps)


def _json(value: Any) -> str:
    text = "–" if value is None else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= PARAMETER_CHARACTERS else f"{text[:PARAMETER_CHARACTERS]}…"


def _parameters(row: dict[str, Any]) -> str:
    rounded = {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in row["parameters"].items()
    }
    return _json(rounded).removeprefix("{").removesuffix("}")
