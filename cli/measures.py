"""`tcmrl-data inspect quality|coverage|rewards|transfer|worth`: measures of a dataset."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from .frame import (
    number,
    output_options,
    print_by_step,
    print_json,
    print_rows,
    remark,
    stopped_by_signals,
    typed_command,
)
from .options import COUNT, DATASET, PLOT
from .progress import PartsProgress, StageProgress

if TYPE_CHECKING:
    from tcmrl_data import Coverage, Quality, Rewards, Transfer, Worth
    from tcmrl_data.dataset.selection import Tier
    from tcmrl_data.quality.measured import Measured
    from tcmrl_data.quality.scores import StageQuality

Found = TypeVar("Found", bound="Measured")
Report = Callable[[str], PartsProgress]
"""Takes the name of a stage and gives what reports its progress."""

UNITS = {"reading": "parts", "playing": "episodes"}


def run_measure(
    measure: Callable[[Report], Found],
    show: Callable[[Found], None],
    draw: Callable[[Found, Path], None],
    *,
    as_json: bool,
    plot: Path | None,
) -> None:
    """Measures with progress, draws the picture if one is wanted, and prints JSON or a table.

    Args:
        measure: does the work.
        show: prints a table.
        draw: draws a picture to a file.
    """
    from tcmrl_data.quality.measured import check_picture

    if plot is not None:
        check_picture(plot)
    with stopped_by_signals(lambda: f"nothing was written; run `{typed_command()}` again"):
        with StageProgress() as progress:

            def report(stage: str) -> PartsProgress:
                return lambda done, total: progress.update(stage, done=done, total=total, unit=UNITS[stage])

            found = measure(report)
        if plot is not None:
            draw(found, plot)
            remark(f"picture written to {plot}")
        if as_json:
            print_json(found.model_dump(mode="json"))
        else:
            show(found)


def title(found: "Measured") -> str:
    """What tables call the dataset."""
    return found.label or found.environment


TIERS_SHOWN: tuple["Tier", ...] = ("random", "medium", "expert")
"""Tiers that the table counts; the others are made of these."""


@click.command()
@DATASET
@output_options
@PLOT
def quality(dataset: Path, as_json: bool, plot: Path | None) -> None:
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
    run_measure(
        lambda progress: tcmrl_data.measure_quality(opened),
        _print_quality,
        plot_quality,
        as_json=as_json,
        plot=plot,
    )


@click.command()
@DATASET
@output_options
@PLOT
def coverage(dataset: Path, as_json: bool, plot: Path | None) -> None:
    """Print state-action coverage by snapshot, beside trajectory quality.

    SACo (arXiv 2111.04714) is the number of different state-action cells of a part, as a share of the cells
    of all parts of its task. Cells form a fixed grid of half of the dataset's standard deviations. With
    many columns nearly every step has a cell of its own, and SACo only tells the number of steps.

    \b
    Examples:
      tcmrl-data inspect coverage data/point-robot
      tcmrl-data inspect coverage data/point-robot --plot coverage.png
    """
    import tcmrl_data
    from tcmrl_data.quality.coverage import plot_coverage

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        lambda progress: tcmrl_data.measure_coverage(opened, progress=progress("reading")),
        _print_coverage,
        plot_coverage,
        as_json=as_json,
        plot=plot,
    )


@click.command()
@DATASET
@output_options
@PLOT
def rewards(dataset: Path, as_json: bool, plot: Path | None) -> None:
    """Print how often stored rewards are zero, and their distribution.

    An episode is silent if all its rewards are zero: it tells nothing of the task, except where the reward
    is not. `--json` has histograms by step and split, and every part.

    \b
    Examples:
      tcmrl-data inspect rewards data/sparse-point-robot
      tcmrl-data inspect rewards data/sparse-point-robot --plot rewards.png
    """
    import tcmrl_data
    from tcmrl_data.quality.rewards import plot_rewards

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        lambda progress: tcmrl_data.measure_rewards(opened, progress=progress("reading")),
        _print_rewards,
        plot_rewards,
        as_json=as_json,
        plot=plot,
    )


def _print_quality(found: "Quality") -> None:
    rows = []
    for stage in found.stages:
        tq = stage.tq
        values = [None] * 4 if tq is None else [tq.mean, tq.iqm, tq.min, tq.max]
        mean, iqm, least, most = map(number, values)
        low, high = (None, None) if tq is None else (tq.low, tq.high)
        interval = "–" if low is None else f"{number(low)} to {number(high)}"
        cells = (f"{stage.parts:,}", mean, iqm, interval, least, most, _tiers(found, stage))
        rows.append((stage.step, stage.split, *cells))
    columns = ["parts", "TQ", "IQM", "95%", "min", "max", "tiers"]
    print_by_step(f"{title(found)}: trajectory quality of snapshots", columns, rows, long_text=["tiers"])


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
    shown = [
        (
            *(stage.step, stage.split, f"{stage.parts:,}", f"{stage.steps:,.0f}", f"{stage.cells:,.0f}"),
            *map(number, (stage.saco, stage.tq)),
        )
        for stage in found.stages
    ]
    print_by_step(f"{title(found)}: means over parts", ["parts", "steps", "cells", "SACo", "TQ"], shown)
    rows, tasks = found.overlap.shares, len(found.overlap.tasks)
    if tasks > 1:
        mean = (sum(map(sum, rows)) - tasks) / (tasks * (tasks - 1))
        click.echo(f"Of the state cells of a task, {mean:.0%} are visited in another task too, on average.")


def _print_rewards(found: "Rewards") -> None:
    rows = [
        (
            *(stage.step, stage.split, f"{stage.parts:,}", f"{stage.steps:,}"),
            *(f"{stage.zero:.1%}", f"{stage.silent:.1%}"),
            *map(number, (stage.mean, stage.min, stage.max)),
        )
        for stage in found.stages
    ]
    columns = ["parts", "steps", "zero", "silent episodes", "mean", "min", "max"]
    print_by_step(f"{title(found)}: stored rewards", columns, rows)


MAX_TASKS = click.option(
    "--max-tasks",
    type=click.IntRange(min=2),
    metavar="N",
    show_default="100, or 20 where a task is simulated",
    help="Most tasks that take part, evenly spread over both splits.",
)
PLAYED_EPISODES = click.option(
    "--episodes", type=COUNT, default=5, show_default=True, help="Episodes of each policy in a task."
)
PLAYED_SEED = click.option(
    "--seed",
    type=click.IntRange(min=0, max=2**32 - 1),
    default=0,
    show_default=True,
    help="Seed of the episodes.",
)


@click.command()
@DATASET
@output_options
@PLOT
@MAX_TASKS
@PLAYED_EPISODES
@PLAYED_SEED
def transfer(
    dataset: Path,
    as_json: bool,
    plot: Path | None,
    max_tasks: int | None,
    episodes: int,
    seed: int,
) -> None:
    """Let the last policy of every task act in every task, and print what it gets.

    A policy never sees in which task it acts. Scores are in units of trajectory quality: 0 for uniform
    actions, 1 for the best return that is known of the task acted in. `--json` has the whole matrix.

    \b
    Examples:
      tcmrl-data inspect transfer data/point-robot --plot transfer.png
      tcmrl-data inspect transfer data/half-cheetah-vel --max-tasks 10 --json
    """
    import tcmrl_data
    from tcmrl_data.quality.transfer import plot_transfer

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        lambda progress: tcmrl_data.measure_transfer(
            opened,
            tasks=max_tasks,
            episodes=episodes,
            seed=seed,
            progress=progress("playing"),
        ),
        _print_transfer,
        plot_transfer,
        as_json=as_json,
        plot=plot,
    )


@click.command()
@DATASET
@output_options
@PLOT
@MAX_TASKS
@PLAYED_EPISODES
@PLAYED_SEED
def worth(
    dataset: Path,
    as_json: bool,
    plot: Path | None,
    max_tasks: int | None,
    episodes: int,
    seed: int,
) -> None:
    """Print whether a context is worth having, before anyone trains.

    Worth: the share of the range from uniform actions to the best known return that the best single policy
    leaves to the tasks' own policies. That policy is one of the training tasks' last policies, and the same
    for test tasks. Visibility: how much better rewards and changes of observations are predicted (5 nearest
    neighbours of observation and action) from other episodes of the same task than from other tasks:
    1 is plain to see, 0 is invisible.

    Worth is an upper bound: a learner without context may do better than the best stored policy. Constant
    rewards have no visibility (–).

    \b
    Examples:
      tcmrl-data inspect worth data/point-robot
      tcmrl-data inspect worth data/half-cheetah-vel --max-tasks 10
    """
    import tcmrl_data
    from tcmrl_data.quality.worth import plot_worth

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        lambda progress: tcmrl_data.measure_worth(
            opened,
            tasks=max_tasks,
            episodes=episodes,
            seed=seed,
            progress=lambda stage, done, total: progress(stage)(done, total),
        ),
        _print_worth,
        plot_worth,
        as_json=as_json,
        plot=plot,
    )


def _print_transfer(found: "Transfer") -> None:
    rows = []
    for place, task in enumerate(found.tasks):
        column = [row[place] for row in found.returns]
        others = [value for source, value in enumerate(column) if source != place]
        elsewhere = [value for target, value in enumerate(found.returns[place]) if target != place]
        scores = [row[place] for other, row in enumerate(found.scores) if other != place]
        known = [score for score in scores if score is not None]
        means = (column[place], sum(others) / len(others), sum(elsewhere) / len(elsewhere))
        of_scores = (found.scores[place][place], sum(known) / len(known) if known else None)
        rows.append((str(task.task), task.split, f"{task.step:,}", *map(number, (*means, *of_scores))))
    heading = f"{title(found)}: last policies in {len(found.tasks)} tasks, {found.episodes} episodes each"
    columns = ["task", "split", "step", "own", "others' policies", "in other tasks", "own score", "others"]
    print_rows(heading, columns, rows, text=["split"])
    _print_left_out(found)


def _print_worth(found: "Worth") -> None:
    columns = ["split", "tasks", "uniform", "best single", "own", "best known", "worth", "95%"]
    rows = []
    for row in found.splits:
        low, high = row.low, row.high
        returns = map(number, (row.uniform, row.single, row.own, row.best))
        share = "–" if row.worth is None else f"{row.worth:.1%}"
        interval = "–" if low is None or high is None else f"{low:.1%} to {high:.1%}"
        rows.append((row.split, str(row.tasks), *returns, share, interval))
    print_rows(f"{title(found)}: what a context can gain", columns, rows, text=["split"])
    if any(row.worth is not None and row.worth > 1 for row in found.splits):
        remark(
            "A worth above 100%: the best known returns are those of stored policies, and own policies now "
            "gained more over the best single one than the range from uniform actions to them."
        )
    shown = [
        (
            *(stage.step, stage.split, str(stage.tasks), f"{stage.rewarded:.1%}"),
            *map(number, (stage.reward, stage.dynamics)),
        )
        for stage in found.stages
    ]
    columns = ["tasks", "rewarded", "in rewards", "in dynamics"]
    print_by_step("visibility of the task, by snapshot", columns, shown)
    click.echo(f"The best single policy is that of task {found.single_task}.")
    _print_left_out(found)


def _print_left_out(found: "Transfer | Worth") -> None:
    if found.left_out:
        click.echo(f"{found.left_out} tasks took no part: incomplete, or more than --max-tasks.")
