"""`tcmrl-data derive`, `merge`, `extend` and `relabel`: datasets of datasets."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import size

from .frame import output_options, print_json, remark
from .options import (
    DATASET,
    DATASET_PATH,
    DRY_RUN,
    INDEX,
    LABEL,
    NEW_DATASET,
    OUT,
    PATH,
    SNAPSHOTS,
    SPLIT,
    TASKS,
    TIER,
    WORKERS,
    allow_only,
    indices,
)
from .progress import PartsProgress, with_progress

if TYPE_CHECKING:
    from tcmrl_data import Derived
    from tcmrl_data.envs.base import Split

SOURCE_RUN = click.option(
    "--run", default="main", show_default=True, metavar="RUN", help="Run of DATASET that is read."
)


@click.command()
@DATASET
@OUT
@click.option(
    "--view",
    type=PATH,
    metavar="PATH",
    help="In place of --out: a .json file that names the parts, or a folder of such files for --folds.",
)
@TIER
@SNAPSHOTS
@TASKS
@SPLIT
@click.option(
    "--held-out", metavar="LIST", help="Tasks that become the test tasks; all others become training tasks."
)
@click.option(
    "--episodes",
    metavar="N",
    help="Only the first N episodes of each part, or a share such as 50%. Of N,M one dataset gets the first "
    "N, another the next M.",
)
@click.option("--folds", type=click.IntRange(min=2), metavar="K", help="Make K datasets: folds of the tasks.")
@click.option("--names", metavar="LIST", help="Names of several datasets, such as fit,holdout.")
@click.option("--seed", type=INDEX, help="Seed that draws episodes, in place of the first, or folds.")
@click.option(
    "--min-return", type=float, metavar="R", help="Only episodes whose undiscounted return is at least R."
)
@click.option("--drop-array", "drop_arrays", multiple=True, metavar="NAME", help="Leave out an extra array.")
@LABEL
@DRY_RUN
@output_options
@click.pass_context
def derive(
    context: click.Context,
    dataset: Path,
    out: Path | None,
    view: Path | None,
    tier: str | None,
    snapshots: str,
    tasks: str | None,
    split: "Split | None",
    held_out: str | None,
    episodes: str | None,
    folds: int | None,
    names: str | None,
    seed: int | None,
    min_return: float | None,
    drop_arrays: tuple[str, ...],
    label: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make datasets of some parts and episodes of DATASET, or views that only name them.

    Tiers follow D4RL's words, by the score of a snapshot on its task: 0 is uniform actions, 100 the oracle,
    the scripted expert or the best snapshot. medium is the first snapshot with a score of at least 33. Whole
    parts keep their ids and bytes. A view opens wherever a dataset does.

    Every task is a test task in one of the --folds, and all folds hold all parts.

    \b
    Examples:
      tcmrl-data derive data/point-robot --tier medium --out data/medium
      tcmrl-data derive data/point-robot --tier expert --view expert.json
      tcmrl-data derive data/point-robot --episodes 10 --seed 0 --out data/few
      tcmrl-data derive data/point-robot --folds 5 --view data/folds
      tcmrl-data derive data/point-robot --episodes 45,5 --out data/two
    """
    import tcmrl_data
    from tcmrl_data.operations.derive import describe_far

    numbers = episodes.split(",") if episodes is not None and "," in episodes else None
    if folds is not None or numbers is not None:
        several = ("out", "view", "folds", "seed", "names", "dry_run")
        allow_only(context, "--folds" if folds else "--episodes N,M", *several, *["episodes"] * (not folds))
        made = _split(dataset, out, view, folds, seed, numbers, names, dry_run)
        _print(made, as_json=as_json, dry_run=dry_run, are_folds=folds is not None)
        return
    if names is not None:
        raise click.UsageError("--names is for several datasets, of --folds K or --episodes N,M.")

    def make(progress: PartsProgress) -> "Derived":
        return tcmrl_data.derive_dataset(
            dataset,
            out,
            view=view,
            tier=tier,
            snapshots=snapshots,
            tasks=indices(tasks),
            split=split,
            held_out=indices(held_out, "--held-out") or (),
            episodes=int(episodes) if episodes is not None and episodes.isdecimal() else episodes,
            seed=seed,
            min_return=min_return,
            drop_arrays=drop_arrays,
            label=label,
            dry_run=dry_run,
            progress=progress,
        )

    derived = with_progress(make, stage="derive", out=out or Path())
    if derived.far_from_medium:
        remark(f"warning: not near a score of 33: {describe_far(derived.far_from_medium)}")
    _print([derived], as_json=as_json, dry_run=dry_run)


def _split(
    dataset: Path,
    out: Path | None,
    view: Path | None,
    folds: int | None,
    seed: int | None,
    numbers: list[str] | None,
    names: str | None,
    dry_run: bool,
) -> "list[Derived]":
    """Several datasets of one: folds, or disjoint episodes."""
    import tcmrl_data

    folder = out or view
    if folder is None or (out and view):
        raise click.UsageError("Name one folder for the datasets, by --out or by --view.")
    if numbers is not None and not all(number.isdecimal() for number in numbers):
        raise click.UsageError(f"--episodes {','.join(numbers)}: expected numbers such as 45,5.")
    return with_progress(
        lambda progress: tcmrl_data.split_dataset(
            dataset,
            folder,
            folds=folds,
            seed=seed or 0,
            episodes=None if numbers is None else [int(number) for number in numbers],
            names=None if names is None else names.split(","),
            views=view is not None,
            dry_run=dry_run,
            progress=progress,
        ),
        stage="derive",
        out=folder,
    )


@click.command()
@click.argument("datasets", metavar="DATASET…", nargs=-1, required=True, type=DATASET_PATH)
@NEW_DATASET
@click.option(
    "--as",
    "names",
    multiple=True,
    metavar="RUN",
    help="Name of a dataset's run in the union; give one per dataset, in order.",
)
@click.option(
    "--split-from",
    type=PATH,
    metavar="DATASET",
    help="The dataset that decides which tasks are training tasks.",
)
@LABEL
@DRY_RUN
@output_options
def merge(
    datasets: tuple[Path, ...],
    out: Path,
    names: tuple[str, ...],
    split_from: Path | None,
    label: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make the union of several datasets of one environment.

    Their order does not matter. A part that several of them hold is taken once. Parts with equal keys and
    different contents, such as those of other seeds, become another run.

    \b
    Examples:
      tcmrl-data merge data/pr-seed0 data/pr-seed1 --out data/pr-two-seeds
      tcmrl-data merge data/a data/b --as first --as second --out data/both
    """
    import tcmrl_data

    def make(progress: PartsProgress) -> "Derived":
        return tcmrl_data.merge_datasets(
            datasets,
            out,
            names=names or None,
            split_from=split_from,
            label=label,
            dry_run=dry_run,
            progress=progress,
        )

    _print([with_progress(make, stage="merge", out=out)], as_json=as_json, dry_run=dry_run)


@click.command()
@DATASET
@click.option(
    "--episodes", type=int, required=True, metavar="N", help="Episodes of every new part; whole lane batches."
)
@click.option(
    "--snapshots",
    default="last",
    show_default=True,
    metavar="RULE",
    help="Policies that act: all, last, steps>=N, or return>=Q with a quantile Q.",
)
@TASKS
@SOURCE_RUN
@click.option(
    "--as", "name", default="extended", show_default=True, metavar="RUN", help="The new run's name."
)
@click.option(
    "--first-episode",
    type=int,
    metavar="N",
    show_default="the first one that is not stored",
    help="Number of the first episode; 0 gives the stored ones again.",
)
@click.option(
    "--noise", type=float, default=0.0, metavar="SIGMA", help="Add normal noise to actions before clipping."
)
@click.option(
    "--cross",
    type=int,
    default=0,
    metavar="K",
    help="Let a policy act in the K nearest tasks of its split instead of its own.",
)
@OUT
@click.option("--allow-drift", is_flag=True, help="Go on although the parts are from another platform.")
@WORKERS
@DRY_RUN
@output_options
def extend(
    dataset: Path,
    episodes: int,
    snapshots: str,
    tasks: str | None,
    run: str,
    name: str,
    first_episode: int | None,
    noise: float,
    cross: int,
    out: Path | None,
    allow_drift: bool,
    workers: int | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Let the stored policies of DATASET act again: more episodes without training.

    The new episodes follow the stored ones: they have the next of the same keyed seeds, and are the same
    whenever they are made on an equal platform. They become a run of their own, in DATASET, or with --out
    in a new dataset that also holds the old parts. Parts that are there are kept, so the same command goes
    on after a stop.

    \b
    Examples:
      tcmrl-data extend data/point-robot --episodes 50
      tcmrl-data extend data/point-robot --episodes 50 --noise 0.3 --as noisy
      tcmrl-data extend data/point-robot --episodes 50 --cross 3 --out data/x
    """
    import tcmrl_data

    opened = tcmrl_data.open_dataset(dataset)
    limit = opened.manifest.recipe.environment.tasks
    report = with_progress(
        lambda progress: tcmrl_data.extend_dataset(
            dataset,
            episodes=episodes,
            out=out,
            run=name,
            of=run,
            tasks=None if tasks is None else tcmrl_data.parse_indices(tasks, limit),
            snapshots=snapshots,
            first_episode=first_episode,
            noise=noise,
            cross=cross,
            allow_drift=allow_drift,
            workers=workers,
            dry_run=dry_run,
            progress=progress,
        ),
        stage="extend",
        out=opened.folder if out is None else out,
    )
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    parts = f"{report.made:,} part{'' if report.made == 1 else 's'} of {report.episodes:,} episodes"
    end = "would be made" if report.root is None else f"made, {report.present:,} already there"
    root = "" if report.root is None else f"; root {report.root[:12]}"
    click.echo(f"{printable(str(report.dataset))}: {parts} {end}, in runs {', '.join(report.runs)}{root}")


@click.command()
@DATASET
@click.option(
    "--to",
    required=True,
    metavar="TASKS",
    help="Tasks whose rewards are wanted: indices such as 0-9,12, or all, or nearest:K.",
)
@NEW_DATASET
@click.option(
    "--tasks", metavar="LIST", show_default="training tasks", help="Tasks whose episodes are taken."
)
@SNAPSHOTS
@SOURCE_RUN
@click.option(
    "--as", "name", default="relabelled", show_default=True, metavar="RUN", help="The new run's name."
)
@click.option("--allow-test", is_flag=True, help="Take test tasks too; nothing can be trained on the result.")
@LABEL
@WORKERS
@DRY_RUN
@output_options
def relabel(
    dataset: Path,
    to: str,
    out: Path,
    tasks: str | None,
    snapshots: str,
    run: str,
    name: str,
    allow_test: bool,
    label: str | None,
    workers: int | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make a dataset of the episodes of DATASET with the rewards of other tasks.

    The episodes are simulated again in the other task. Their observations must come back bit for bit, so that
    tasks which differ in more than rewards are refused. --dry-run tries one episode per task.

    \b
    Examples:
      tcmrl-data relabel data/half-cheetah-vel --to nearest:3 --out data/new
      tcmrl-data relabel data/point-robot --to all --out data/new
    """
    import tcmrl_data

    limit = tcmrl_data.open_dataset(dataset).manifest.recipe.environment.tasks

    def parse(text: str, option: str) -> list[int]:
        return tcmrl_data.parse_indices(text, limit, option=option)

    targets = to if to == "all" or to.startswith("nearest") else parse(to, "--to")
    report = with_progress(
        lambda progress: tcmrl_data.relabel_dataset(
            dataset,
            out,
            to=targets,
            tasks=None if tasks is None else parse(tasks, "--tasks"),
            snapshots=snapshots,
            of=run,
            run=name,
            allow_test=allow_test,
            label=label,
            workers=workers,
            dry_run=dry_run,
            progress=progress,
        ),
        stage="relabel",
        out=out,
    )
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    counts = f"{report.parts:,} parts with {report.steps:,} steps of {report.pairs:,} pairs of tasks"
    end = " would be made" if report.root is None else f"; root {report.root[:12]}"
    click.echo(f"{printable(str(report.dataset))}: {counts} in {len(report.runs)} runs{end}")


def _print(datasets: "list[Derived]", *, as_json: bool, dry_run: bool, are_folds: bool = False) -> None:
    """Prints what was made, or would be."""
    if as_json:
        print_json({"dry_run": dry_run, "datasets": list(map(dataclasses.asdict, datasets))})
        return
    from tcmrl_data.foundation.records import write_ranges

    for made in datasets:
        steps = made.steps
        span = f"step {steps[0]:,}" if len(steps) == 1 else f"steps {steps[0]:,} to {steps[-1]:,}"
        cut = f", {made.cut:,} of them cut" if made.cut else ""
        root = f"; root {made.root[:12]}" if made.root else ""
        would = "would have " if dry_run else ""
        tests = f" (test {write_ranges(made.test_tasks)})" if are_folds else ""
        most = " at most" if dry_run and made.cut else ""
        sources = ", ".join(source[:12] for source in made.sources)
        click.echo(
            f"{printable(str(made.out))}: {would}{made.parts:,} parts{cut}, {made.tasks:,} tasks{tests}, "
            f"{span}, {size(made.bytes)}{most}{root}, derived from {sources}"
        )
