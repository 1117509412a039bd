"""`tcmrl-data extend` and `relabel`."""

import dataclasses
from pathlib import Path

import click

from tcmrl_data.foundation.plain_files import printable

from .frame import output_options, print_json
from .options import PROCESSES
from .places import DATASET_PATH
from .progress import with_progress

DATASET = click.argument("dataset", type=DATASET_PATH)


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
@click.option("--tasks", metavar="LIST", show_default="all", help="Tasks whose policies act, such as 0-9,12.")
@click.option("--of", default="main", show_default=True, metavar="RUN", help="Run whose policies act.")
@click.option("--run", default="extended", show_default=True, metavar="RUN", help="Name of the new run.")
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
@click.option("--out", type=click.Path(path_type=Path), metavar="FOLDER", help="Make a new dataset.")
@click.option("--allow-drift", is_flag=True, help="Go on although the parts are from another platform.")
@PROCESSES
@click.option("--dry-run", is_flag=True, help="Check and count only.")
@output_options
def extend(
    dataset: Path,
    episodes: int,
    snapshots: str,
    tasks: str | None,
    of: str,
    run: str,
    first_episode: int | None,
    noise: float,
    cross: int,
    out: Path | None,
    allow_drift: bool,
    workers: int | None,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Let the stored policies of DATASET act again: more episodes without training.

    The new episodes follow the stored ones: they have the next of the same keyed seeds, and are the same
    whenever they are made on an equal platform. They become a run of their own, in DATASET, or with --out
    in a new dataset that also holds the old parts. Parts that are there are kept, so the same command goes
    on after a stop.

    \b
    Examples:
      tcmrl-data extend data/point-robot --episodes 50
      tcmrl-data extend data/point-robot --episodes 50 --noise 0.3 --run noisy --snapshots "steps>=2000"
      tcmrl-data extend data/point-robot --episodes 50 --cross 3 --run visitors --out data/point-robot-visited
    """
    import tcmrl_data

    opened = tcmrl_data.open_dataset(dataset)
    limit = opened.manifest.recipe.environment.tasks
    chosen = None if tasks is None else tcmrl_data.parse_indices(tasks, limit)
    target = opened.folder if out is None else out
    report = with_progress(
        lambda progress: tcmrl_data.extend_dataset(
            dataset,
            episodes=episodes,
            out=out,
            run=run,
            of=of,
            tasks=chosen,
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
        out=target,
        quiet=quiet,
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
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="New dataset.")
@click.option(
    "--tasks", metavar="LIST", show_default="training tasks", help="Tasks whose episodes are taken."
)
@click.option(
    "--snapshots",
    default="all",
    show_default=True,
    metavar="RULE",
    help="Parts to take: all, last, steps>=N, or return>=Q with a quantile Q.",
)
@click.option("--of", default="main", show_default=True, metavar="RUN", help="Run whose parts are taken.")
@click.option("--run", default="relabelled", show_default=True, metavar="RUN", help="Name of the new run.")
@click.option("--allow-test", is_flag=True, help="Take test tasks too; training refuses what comes of them.")
@click.option("--label", help="The new dataset's own name.")
@PROCESSES
@click.option("--dry-run", is_flag=True, help="Check, count, and try one episode per task only.")
@output_options
def relabel(
    dataset: Path,
    to: str,
    out: Path,
    tasks: str | None,
    snapshots: str,
    of: str,
    run: str,
    allow_test: bool,
    label: str | None,
    workers: int | None,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a dataset of the episodes of DATASET with the rewards of other tasks.

    The episodes are simulated again in the other task. Their observations must come back bit for bit, so that
    tasks which differ in more than rewards are refused.

    \b
    Examples:
      tcmrl-data relabel data/half-cheetah-vel --to nearest:3 --out data/relabelled
      tcmrl-data relabel data/point-robot --to all --tasks 0-4 --snapshots last --out data/relabelled
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
            of=of,
            run=run,
            allow_test=allow_test,
            label=label,
            workers=workers,
            dry_run=dry_run,
            progress=progress,
        ),
        stage="relabel",
        out=out,
        quiet=quiet,
    )
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    counts = f"{report.parts:,} parts with {report.steps:,} steps of {report.pairs:,} pairs of tasks"
    end = " would be made" if report.root is None else f"; root {report.root[:12]}"
    click.echo(f"{printable(str(report.dataset))}: {counts} in {len(report.runs)} runs{end}")
