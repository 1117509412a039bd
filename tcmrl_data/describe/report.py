"""The report on a dataset: one HTML file, to be read in a browser or printed."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import summarize_returns
from tcmrl_data.describe.card import tier_rows
from tcmrl_data.describe.measures import Content, StageProgress, measure
from tcmrl_data.describe.verdicts import judge
from tcmrl_data.foundation.disk import make_folders, replace_file
from tcmrl_data.foundation.errors import RenderingError
from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.page import render_page
from tcmrl_data.foundation.plain_files import printable

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
    strips: int = 0,
    progress: StageProgress | None = None,
) -> Path:
    """Writes the report on a dataset and returns its file.

    The dataset is read part by part; memory does not grow with the number of parts. Needs the extra `report`.

    Args:
        dataset: the dataset; of an incomplete one, what is there.
        out: the HTML file, which is replaced if it exists.
        episodes: number of whole episodes to browse.
        transfer: let every last policy play in every task, and say what a context is worth; takes longer.
        strips: number of episodes to draw, by simulating them again; as many as can be drawn.
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
    content = measure(dataset, browsed=episodes, transfer=transfer, strips=strips, progress=progress)
    out = Path(out)
    make_folders(out.parent)
    replace_file(out, report_html(content, progress).encode())
    return out


def report_html(content: Content, progress: StageProgress | None = None) -> str:
    """The page of a report.

    Args:
        content: what it shows.
        progress: called after every figure, which takes longer than reading a small dataset.

    Raises:
        RenderingError: plotly is not installed.
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
    """Lengths and endings of episodes by snapshot."""
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
    """How the parts were made."""
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
