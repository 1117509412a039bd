"""`tcmrl-data inspect transfer|worth`: policies in other tasks, and whether a context is worth having."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .frame import make_table, number, print_table
from .inspection import dataset_command
from .measuring import MeasureOptions, plot_option, run_measure, stage_cells, title

if TYPE_CHECKING:
    from tcmrl_data import Transfer, Worth


def played(command: Any) -> Any:
    """Adds the options of measures that play episodes."""
    options = (
        click.option(
            "--tasks",
            type=click.IntRange(min=2),
            metavar="N",
            show_default="100, or 20 where a task is simulated",
            help="Most tasks that take part, evenly spread over both splits.",
        ),
        click.option(
            "--episodes",
            type=click.IntRange(min=1),
            default=5,
            show_default=True,
            metavar="N",
            help="Episodes of a policy in a task.",
        ),
        click.option(
            "--seed",
            type=click.IntRange(min=0, max=2**32 - 1),
            default=0,
            show_default=True,
            help="Seed of the episodes.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


@click.command()
@dataset_command
@plot_option
@played
@click.option("--deterministic", is_flag=True, help="Let policies act without their noise.")
def transfer(
    dataset: Path,
    as_json: bool,
    quiet: bool,
    plot: Path | None,
    tasks: int | None,
    episodes: int,
    seed: int,
    deterministic: bool,
) -> None:
    """Let the last policy of every task act in every task, and print what it gets.

    A policy never sees in which task it acts. Scores are in units of trajectory quality: 0 for uniform
    actions, 1 for the best return that is known of the task acted in. `--json` has the whole matrix.

    \b
    Examples:
      tcmrl-data inspect transfer data/point-robot --plot transfer.png
      tcmrl-data inspect transfer data/half-cheetah-vel --tasks 10 --episodes 1 --json
    """
    import tcmrl_data
    from tcmrl_data.quality.transfer import plot_transfer

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        MeasureOptions(as_json, quiet, plot),
        lambda progress: tcmrl_data.measure_transfer(
            opened,
            tasks=tasks,
            episodes=episodes,
            seed=seed,
            deterministic=deterministic,
            progress=progress("playing"),
        ),
        _print_transfer,
        plot_transfer,
    )


@click.command()
@dataset_command
@plot_option
@played
@click.option(
    "--transitions",
    type=click.IntRange(min=5),
    default=500,
    show_default=True,
    metavar="N",
    help="Most transitions of a part that are predicted, and most that predict.",
)
def worth(
    dataset: Path,
    as_json: bool,
    quiet: bool,
    plot: Path | None,
    tasks: int | None,
    episodes: int,
    seed: int,
    transitions: int,
) -> None:
    """Print whether a context is worth having, before anyone trains.

    Worth: the share of the range from uniform actions to the best known return that the best single policy
    leaves to the tasks' own policies. That policy is one of the training tasks' last policies, and the same
    for test tasks. Visibility: how much better rewards and changes of observations are predicted (5 nearest
    neighbours of observation and action) from other episodes of the same task than from other tasks:
    1 is plain to see, 0 is invisible.

    Weak spots: a learner without context may do better than the best stored policy, so that worth is an
    upper bound; poor policies of a task's own make it low. Constant rewards have no visibility (–). Where
    policies are narrow, visibility in dynamics mixes the task with the coverage. What only a sequence of
    transitions tells is not seen.

    \b
    Examples:
      tcmrl-data inspect worth data/point-robot
      tcmrl-data inspect worth data/half-cheetah-vel --tasks 10 --episodes 1 --plot worth.png
    """
    import tcmrl_data
    from tcmrl_data.quality.worth import plot_worth

    opened = tcmrl_data.open_dataset(dataset)
    run_measure(
        MeasureOptions(as_json, quiet, plot),
        lambda progress: tcmrl_data.measure_worth(
            opened,
            tasks=tasks,
            episodes=episodes,
            seed=seed,
            transitions=transitions,
            progress=lambda stage, done, total: progress(stage)(done, total),
        ),
        _print_worth,
        plot_worth,
    )


def _print_transfer(found: "Transfer") -> None:
    table = make_table(
        f"{title(found)}: last policies in {len(found.tasks)} tasks, {found.episodes} episodes each",
        columns=["task", "split", "step", "own", "others' policies", "in other tasks", "own score", "others"],
        text=["split"],
    )
    for place, task in enumerate(found.tasks):
        column = [row[place] for row in found.returns]
        others = [value for source, value in enumerate(column) if source != place]
        elsewhere = [value for target, value in enumerate(found.returns[place]) if target != place]
        scores = [row[place] for other, row in enumerate(found.scores) if other != place]
        known = [score for score in scores if score is not None]
        table.add_row(
            str(task.task),
            task.split,
            f"{task.step:,}",
            number(column[place]),
            number(sum(others) / len(others)),
            number(sum(elsewhere) / len(elsewhere)),
            number(found.scores[place][place]),
            number(sum(known) / len(known) if known else None),
        )
    print_table(table)
    _print_left_out(found)


def _print_worth(found: "Worth") -> None:
    columns = ["split", "tasks", "uniform", "best single", "own", "best known", "worth", "95%"]
    table = make_table(f"{title(found)}: what a context can gain", columns=columns, text=["split"])
    for row in found.splits:
        low, high = row.low, row.high
        table.add_row(
            row.split,
            str(row.tasks),
            *(number(value) for value in (row.uniform, row.single, row.own, row.best)),
            "–" if row.worth is None else f"{row.worth:.1%}",
            "–" if low is None or high is None else f"{low:.1%} to {high:.1%}",
        )
    print_table(table)
    columns = ["step", "split", "tasks", "rewarded", "in rewards", "in dynamics"]
    table = make_table("visibility of the task, by snapshot", columns=columns, text=["split"])
    for previous, stage in zip([None, *found.stages], found.stages, strict=False):
        table.add_row(
            *stage_cells(previous, stage),
            str(stage.tasks),
            f"{stage.rewarded:.1%}",
            number(stage.reward),
            number(stage.dynamics),
        )
    print_table(table)
    click.echo(f"The best single policy is that of task {found.single_task}.")
    _print_left_out(found)


def _print_left_out(found: "Transfer | Worth") -> None:
    if found.left_out:
        click.echo(f"{found.left_out} tasks took no part: incomplete, or more than --tasks.")
