"""`tcmrl-data inspect quality|coverage|rewards`: what the parts of a dataset hold."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .frame import make_table, number, print_table
from .inspection import dataset_command
from .measuring import MeasureOptions, plot_option, run_measure, stage_cells, title

if TYPE_CHECKING:
    from tcmrl_data import Coverage, Quality, Rewards
    from tcmrl_data.dataset.selection import Tier
    from tcmrl_data.quality.scores import StageQuality

TIERS_SHOWN: tuple["Tier", ...] = ("random", "medium", "expert")
"""Tiers that the table counts; the others are made of these."""


@click.command()
@dataset_command
@plot_option
def quality(dataset: Path, as_json: bool, quiet: bool, plot: Path | None) -> None:
    """Print trajectory quality and tiers by snapshot; reads tables alone.

    Trajectory quality (TQ, arXiv 2111.04714) is 0 for the return of uniform actions and 1 for the best
    return that is known of a task: of its oracle, else its scripted expert, else its best snapshot. The
    interval is a bootstrap over tasks. `--json` has the tiers of every part.

    \b
    Examples:
      tcmrl-data inspect quality data/point-robot
      tcmrl-data inspect quality data/point-robot --json --plot quality.png
    """
    import tcmrl_data
    from tcmrl_data.quality.scores import plot_quality

    opened = tcmrl_data.open_dataset(dataset)
    options = MeasureOptions(as_json, quiet, plot)
    run_measure(options, lambda progress: tcmrl_data.measure_quality(opened), _print_quality, plot_quality)


@click.command()
@dataset_command
@plot_option
@click.option(
    "--cell",
    type=click.FloatRange(min=0, min_open=True),
    default=0.5,
    show_default=True,
    metavar="WIDTH",
    help="Width of a cell in standard deviations.",
)
@click.option(
    "--tasks",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    metavar="N",
    help="Tasks in the matrix of overlaps, evenly spread; --json has it.",
)
def coverage(dataset: Path, as_json: bool, quiet: bool, plot: Path | None, cell: float, tasks: int) -> None:
    """Print state-action coverage by snapshot, beside trajectory quality.

    SACo (arXiv 2111.04714) is the number of different state-action cells of a part, as a share of the cells
    of all parts of its task. Cells form a fixed grid in units of the dataset's standard deviations. With
    many columns nearly every step has a cell of its own, and SACo only tells the number of steps.

    \b
    Examples:
      tcmrl-data inspect coverage data/point-robot
      tcmrl-data inspect coverage data/point-robot --cell 1 --json --plot coverage.png
    """
    import tcmrl_data
    from tcmrl_data.quality.coverage import plot_coverage

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        MeasureOptions(as_json, quiet, plot),
        lambda progress: tcmrl_data.measure_coverage(
            opened, cell=cell, overlap_tasks=tasks, progress=progress("reading")
        ),
        _print_coverage,
        plot_coverage,
    )


@click.command()
@dataset_command
@plot_option
@click.option(
    "--bins", type=click.IntRange(min=1), default=40, show_default=True, help="Bins of the histograms."
)
def rewards(dataset: Path, as_json: bool, quiet: bool, plot: Path | None, bins: int) -> None:
    """Print how often stored rewards are zero, and their distribution.

    An episode is silent if all its rewards are zero: it tells nothing of the task, except where the reward
    is not. `--json` has histograms by step and split, and every part.

    \b
    Examples:
      tcmrl-data inspect rewards data/sparse-point-robot
      tcmrl-data inspect rewards data/sparse-point-robot --json --plot rewards.png
    """
    import tcmrl_data
    from tcmrl_data.quality.rewards import plot_rewards

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        MeasureOptions(as_json, quiet, plot),
        lambda progress: tcmrl_data.measure_rewards(opened, bins=bins, progress=progress("reading")),
        _print_rewards,
        plot_rewards,
    )


def _print_quality(found: "Quality") -> None:
    columns = ["step", "split", "parts", "TQ", "IQM", "95%", "min", "max", "tiers"]
    table = make_table(
        f"{title(found)}: trajectory quality of snapshots",
        columns=columns,
        text=["split"],
        long_text=["tiers"],
    )
    for previous, stage in zip([None, *found.stages], found.stages, strict=False):
        tq = stage.tq
        values = [None] * 4 if tq is None else [tq.mean, tq.iqm, tq.min, tq.max]
        mean, iqm, least, most = map(number, values)
        low, high = (None, None) if tq is None else (tq.low, tq.high)
        table.add_row(
            *stage_cells(previous, stage),
            f"{stage.parts:,}",
            mean,
            iqm,
            "–" if low is None else f"{number(low)} to {number(high)}",
            least,
            most,
            _tiers(found, stage),
        )
    print_table(table)


def _tiers(found: "Quality", stage: "StageQuality") -> str:
    """How many parts of a stage each tier takes; those that take whole halves of others are left out."""
    counts = Counter(
        tier
        for task in found.tasks
        if task.split == stage.split
        for snapshot in task.snapshots
        if snapshot.step == stage.step
        for tier in snapshot.tiers
    )
    return ", ".join(f"{tier} {counts[tier]}" for tier in TIERS_SHOWN if counts[tier])


def _print_coverage(found: "Coverage") -> None:
    columns = ["step", "split", "parts", "steps", "cells", "SACo", "TQ"]
    table = make_table(f"{title(found)}: means over parts", columns=columns, text=["split"])
    for previous, stage in zip([None, *found.stages], found.stages, strict=False):
        table.add_row(
            *stage_cells(previous, stage),
            f"{stage.parts:,}",
            f"{stage.steps:,.0f}",
            f"{stage.cells:,.0f}",
            number(stage.saco),
            number(stage.tq),
        )
    print_table(table)
    rows, tasks = found.overlap.shares, len(found.overlap.tasks)
    if tasks > 1:
        mean = (sum(map(sum, rows)) - tasks) / (tasks * (tasks - 1))
        click.echo(f"Of the state cells of a task, {mean:.0%} are visited in another task too, on average.")


def _print_rewards(found: "Rewards") -> None:
    columns = ["step", "split", "parts", "steps", "zero", "silent episodes", "mean", "min", "max"]
    table = make_table(f"{title(found)}: stored rewards", columns=columns, text=["split"])
    for previous, stage in zip([None, *found.stages], found.stages, strict=False):
        table.add_row(
            *stage_cells(previous, stage),
            f"{stage.parts:,}",
            f"{stage.steps:,}",
            f"{stage.zero:.1%}",
            f"{stage.silent:.1%}",
            *(number(value) for value in (stage.mean, stage.min, stage.max)),
        )
    print_table(table)
