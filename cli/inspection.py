"""`tcmrl-data inspect`: what a dataset holds and how good it is, as tables, JSON and pictures."""

import json
import math
from pathlib import Path
from typing import Any

import click

from .frame import (
    number,
    output_options,
    print_by_step,
    print_json,
    print_rows,
    remark,
)
from .groups import Commands
from .measures import coverage, quality, rewards, transfer, worth
from .options import DATASET, INDEX, PLOT

SHIFTS_SHOWN = 8
"""Parameters whose shift is printed; a walker has more than fifty."""


@click.group(cls=Commands)
def inspect() -> None:
    """Print returns, tasks, snapshots, episodes or a measure of a dataset.

    \b
    Examples:
      tcmrl-data inspect returns data/point-robot
      tcmrl-data inspect episodes data/point-robot --task 7
    """


@click.command()
@DATASET
@output_options
@PLOT
def returns(dataset: Path, as_json: bool, plot: Path | None) -> None:
    """Print undiscounted returns by snapshot, for training and test tasks.

    \b
    Example:
      tcmrl-data inspect returns data/point-robot --plot returns.png
    """
    import tcmrl_data
    from tcmrl_data.dataset.listing import summarize_returns
    from tcmrl_data.quality.scores import plot_returns

    opened = tcmrl_data.open_dataset(dataset)
    table = tcmrl_data.list_returns(opened)
    if plot is not None:
        plot_returns(opened, table, plot)
        remark(f"learning curves written to {plot}")
    if as_json:
        print_json(table)
    else:
        _print_returns(table["name"], summarize_returns(table))


def _print_returns(name: str, rows: list[dict[str, Any]]) -> None:
    with_success = any(row["success_rate"] is not None for row in rows)
    columns = ["tasks", "episodes", "mean", "std", "min", "max"]
    cells = []
    for row in rows:
        success = [f"{row['success_rate']:.0%}"] if row["success_rate"] is not None else []
        values = (number(row[key]) for key in ("mean", "std", "min", "max"))
        counts = (str(row["tasks"]), f"{row['episodes']:,}")
        cells.append((row["step"], row["split"], *counts, *values, *success))
    print_by_step(f"{name}: mean return of a task, over tasks", columns + ["success"] * with_success, cells)


@click.command()
@DATASET
@output_options
def tasks(dataset: Path, as_json: bool) -> None:
    """Print the tasks with split, parameters and reference returns, and how training and test tasks differ.

    The second table has the mean of what orders the tasks, or of each numeric parameter, in training and test
    tasks, and their difference, also in standard deviations of the training tasks.

    \b
    Example:
      tcmrl-data inspect tasks data/point-robot
    """
    import tcmrl_data
    from tcmrl_data.dataset.listing import list_tasks

    document = list_tasks(tcmrl_data.open_dataset(dataset))
    if as_json:
        print_json(document)
        return
    references = ["uniform", "oracle", "scripted", "behavior"]
    rows = []
    for row in document["tasks"]:
        known = row["references"] or dict.fromkeys(references)
        values = (number(known[reference]) for reference in references)
        rows.append((str(row["task"]), row["split"], _shortened(row["parameters"]), *values))
    columns = ["task", "split", "parameters", *references]
    print_rows(f"{document['name']}: tasks", columns, rows, text=["split"], long_text=["parameters"])
    _print_shift(document)


def _print_shift(document: dict[str, Any]) -> None:
    """Prints the shifts of at most SHIFTS_SHOWN parameters, the largest ones first."""
    rows = sorted(document["shift"], key=_size, reverse=True)
    if not rows:
        return
    columns = ["train", "test", "difference", "standardized"]
    print_rows(
        f"{document['name']}: means of training and test tasks",
        ["parameter", *columns],
        [(row["parameter"], *(number(row[name]) for name in columns)) for row in rows[:SHIFTS_SHOWN]],
        text=["parameter"],
    )
    if len(rows) > SHIFTS_SHOWN:
        remark(f"{len(rows) - SHIFTS_SHOWN} more parameters differ less; --json has all")


def _size(row: dict[str, Any]) -> float:
    return math.inf if row["standardized"] is None else abs(row["standardized"])


@click.command()
@DATASET
@output_options
def snapshots(dataset: Path, as_json: bool) -> None:
    """Print the snapshots with the ids of their parts.

    \b
    Example:
      tcmrl-data inspect snapshots data/point-robot
    """
    import tcmrl_data
    from tcmrl_data.dataset.listing import list_snapshots

    document = list_snapshots(tcmrl_data.open_dataset(dataset))
    if as_json:
        print_json(document)
        return
    columns = ["task", "split", "step", "id", "episodes", "steps", "mean return"]
    rows = []
    for row in document["snapshots"]:
        counts = (f"{row['episodes']:,}", f"{row['steps']:,}", number(row["mean"]))
        rows.append((str(row["task"]), row["split"], f"{row['step']:,}", row["id"][:12], *counts))
    print_rows(f"{document['name']}: snapshots", columns, rows, text=["split", "id"])


@click.command()
@DATASET
@output_options
@click.option("--task", type=INDEX, help="Index of the only task to print.")
@click.option("--step", type=INDEX, help="Training step of the only snapshots to print.")
def episodes(dataset: Path, as_json: bool, task: int | None, step: int | None) -> None:
    """Print the episodes with length, return, kind of end and success.

    \b
    Example:
      tcmrl-data inspect episodes data/point-robot --task 7 --step 3000
    """
    import tcmrl_data
    from tcmrl_data.dataset.listing import list_episodes

    document = list_episodes(tcmrl_data.open_dataset(dataset), task=task, step=step)
    if as_json:
        print_json(document)
        return
    columns = ["task", "step", "episode", "length", "return", "ended", "success"]
    rows = []
    for row in document["episodes"]:
        success = "–" if row["success"] is None else "yes" if row["success"] else "no"
        ended = "terminated" if row["terminated"] else "truncated" if row["truncated"] else "–"
        counts = (str(row["task"]), f"{row['step']:,}", str(row["episode"]), str(row["length"]))
        rows.append((*counts, number(row["return"]), ended, success))
    print_rows(f"{document['name']}: episodes", columns, rows, text=["ended", "success"])


def _shortened(parameters: dict[str, Any]) -> str:
    """Parameters in one line, floats with three decimals, lists with at most six items."""

    def shorten(value: Any) -> Any:
        if isinstance(value, float):
            return round(value, 3)
        if isinstance(value, list):
            return [shorten(item) for item in value[:6]] + ["…"] * (len(value) > 6)
        if isinstance(value, dict):
            return {key: shorten(item) for key, item in value.items()}
        return value

    return ", ".join(
        f"{key}={json.dumps(shorten(value), ensure_ascii=False)}" for key, value in parameters.items()
    )


inspect.fill(
    {
        "Contents": [returns, tasks, snapshots, episodes],
        "Measures": [quality, coverage, rewards, transfer, worth],
    }
)
