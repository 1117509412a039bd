"""`tcmrl-data derive`, `merge`, `split`, `rename` and `delete`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.errors import TierError
from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable

from .frame import fail_incomplete, output_options, print_json, remark
from .places import DATASET_PATH
from .progress import PartsProgress, with_progress

if TYPE_CHECKING:
    from tcmrl_data import Derived

TIERS = ("random", "medium", "medium-replay", "expert", "medium-expert", "random-expert", "mixed")
SOURCE = click.argument("dataset", type=DATASET_PATH)
OUT = click.option("--out", type=click.Path(path_type=Path), metavar="FOLDER", help="Folder to create.")
LABEL = click.option("--label", help="The new dataset's own name.")
DRY_RUN = click.option("--dry-run", is_flag=True, help="Only say what would be made; write nothing.")


@click.command()
@SOURCE
@OUT
@click.option(
    "--view",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a small .json file that names the parts, instead of copying them.",
)
@click.option("--tier", type=click.Choice(TIERS), metavar="NAME", help=f"Quality tier: {', '.join(TIERS)}.")
@click.option(
    "--snapshots",
    default="all",
    show_default=True,
    metavar="RULE",
    help="Instead of a tier: all, last, steps>=N, or return>=Q with a quantile Q.",
)
@click.option("--tasks", metavar="LIST", help="Only these tasks, such as 0-9,12.")
@click.option("--split", type=click.Choice(["train", "test"]), help="Only tasks of this split.")
@click.option(
    "--held-out",
    metavar="LIST",
    help="Chosen tasks that become the test tasks; all others become training tasks.",
)
@click.option(
    "--episodes", metavar="N", help="Only the first N episodes of each part, or a share such as 50%."
)
@click.option("--seed", type=click.IntRange(min=0), help="Draw the episodes instead of taking the first.")
@click.option(
    "--min-return", type=float, metavar="R", help="Only episodes whose undiscounted return is at least R."
)
@click.option("--drop-array", "drop_arrays", multiple=True, metavar="NAME", help="Leave out an extra array.")
@LABEL
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0),
    default=15.0,
    show_default=True,
    help="Distance from a score of 33 up to which a snapshot counts as medium without a warning.",
)
@click.option("--strict", is_flag=True, help="Make nothing, with exit code 1, instead of that warning.")
@DRY_RUN
@output_options
def derive(
    dataset: Path,
    out: Path | None,
    view: Path | None,
    tier: str | None,
    snapshots: str,
    tasks: str | None,
    split: str | None,
    held_out: str | None,
    episodes: str | None,
    seed: int | None,
    min_return: float | None,
    drop_arrays: tuple[str, ...],
    label: str | None,
    tolerance: float,
    strict: bool,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a dataset of some parts and episodes of DATASET, or a view that only names them.

    Tiers follow D4RL's words, by the score of a snapshot on its task: 0 is uniform actions, 100 the oracle,
    the scripted expert or the best snapshot. medium is the first snapshot with a score of at least 33. Whole
    parts keep their ids and bytes. A view opens wherever a dataset does.

    \b
    Examples:
      tcmrl-data derive data/point-robot --tier medium --out data/point-robot-medium
      tcmrl-data derive data/point-robot --tier expert --view expert.json
      tcmrl-data derive data/point-robot --episodes 10 --seed 0 --split train --out data/few-episodes
    """
    import tcmrl_data
    from tcmrl_data.operations.derive import describe_far

    def make(progress: PartsProgress) -> "Derived":
        return tcmrl_data.derive_dataset(
            dataset,
            out,
            view=view,
            tier=tier,
            snapshots=snapshots,
            tasks=None if tasks is None else tcmrl_data.parse_indices(tasks, tcmrl_data.MAX_TASKS),
            split="train" if split == "train" else "test" if split else None,
            held_out=() if held_out is None else _indices(held_out, "--held-out"),
            episodes=int(episodes) if episodes is not None and episodes.isdecimal() else episodes,
            seed=seed,
            min_return=min_return,
            drop_arrays=drop_arrays,
            label=label,
            tolerance=tolerance,
            strict=strict,
            dry_run=dry_run,
            progress=progress,
        )

    try:
        made = with_progress(make, stage="derive", out=out or Path(), quiet=quiet)
    except TierError as error:
        fail_incomplete(f"{error}; choose another tier, or a larger --tolerance")
        return
    if made.far_from_medium:
        remark(f"warning: not near a score of 33: {describe_far(made.far_from_medium)}", quiet=quiet)
    _print([made], as_json=as_json, dry_run=dry_run)


def _indices(text: str, option: str) -> list[int]:
    from tcmrl_data import MAX_TASKS, parse_indices

    return parse_indices(text, MAX_TASKS, option=option)


@click.command()
@click.argument("datasets", nargs=-1, required=True, type=DATASET_PATH)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="Folder to create."
)
@click.option(
    "--as",
    "names",
    multiple=True,
    metavar="NAME",
    help="Name of a dataset's run in the union; give one per dataset, in order.",
)
@click.option(
    "--split-from",
    type=click.Path(path_type=Path),
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
    quiet: bool,
) -> None:
    """Make the union of DATASETS, which are of one environment.

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

    made = with_progress(make, stage="merge", out=out, quiet=quiet)
    _print([made], as_json=as_json, dry_run=dry_run)


@click.command()
@SOURCE
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="Folder to fill."
)
@click.option("--folds", type=click.IntRange(min=2), metavar="K", help="Make K folds of the tasks.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Draws the folds.")
@click.option("--episodes", metavar="LIST", help="Split every part by episodes, such as 45,5.")
@click.option("--names", metavar="LIST", help="Names of the new datasets, such as fit,holdout.")
@click.option("--views", is_flag=True, help="Make a view file per fold instead of copies.")
@DRY_RUN
@output_options
def split(
    dataset: Path,
    out: Path,
    folds: int | None,
    seed: int,
    episodes: str | None,
    names: str | None,
    views: bool,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make several datasets of DATASET: folds of its tasks, or disjoint episodes of its parts.

    Every task is a test task in one of the folds. All folds hold all parts.

    \b
    Examples:
      tcmrl-data split data/point-robot --folds 5 --seed 0 --views --out data/folds
      tcmrl-data split data/point-robot --episodes 45,5 --names fit,holdout --out data/held-out
    """
    import tcmrl_data

    numbers = None if episodes is None else episodes.split(",")
    if numbers is not None and not all(number.isdecimal() for number in numbers):
        raise click.UsageError(f"--episodes {episodes}: expected numbers such as 45,5.")

    def make(progress: PartsProgress) -> "list[Derived]":
        return tcmrl_data.split_dataset(
            dataset,
            out,
            folds=folds,
            seed=seed,
            episodes=None if numbers is None else [int(number) for number in numbers],
            names=None if names is None else names.split(","),
            views=views,
            dry_run=dry_run,
            progress=progress,
        )

    made = with_progress(make, stage="split", out=out, quiet=quiet)
    _print(made, as_json=as_json, dry_run=dry_run)


@click.command()
@SOURCE
@click.argument("label")
@output_options
def rename(dataset: Path, label: str, as_json: bool, quiet: bool) -> None:
    """Give DATASET the name LABEL. Its folder and its root stay as they are.

    \b
    Example:
      tcmrl-data rename data/pr-two-seeds pr/two-seeds
    """
    import tcmrl_data

    manifest = tcmrl_data.rename_dataset(dataset, label)
    if as_json:
        print_json(
            {"dataset": str(dataset), "label": label, "digest": manifest.digest, "root": manifest.root}
        )
    else:
        click.echo(f"{printable(str(dataset))}: label {label}, root {manifest.root[:12]} as before")


@click.command()
@SOURCE
@click.option("--yes", is_flag=True, help="Do not ask.")
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@output_options
def delete(dataset: Path, yes: bool, dry_run: bool, as_json: bool, quiet: bool) -> None:
    """Delete DATASET, or what a stopped command left of one.

    Files in its folder that are no part of a dataset are listed and kept. A dataset that a process works on
    is not deleted.

    \b
    Examples:
      tcmrl-data delete data/point-robot-medium --dry-run
      tcmrl-data delete data/point-robot-medium --yes
    """
    import tcmrl_data

    found = tcmrl_data.delete_dataset(dataset, dry_run=True)
    what = f"{found.files:,} files, {size(found.bytes)}"
    if not dry_run:
        if not yes:
            click.confirm(f"Delete {printable(str(dataset))}, {what}?", abort=True, err=True)
        found = tcmrl_data.delete_dataset(dataset)
    if as_json:
        print_json(dataclasses.asdict(found) | {"dry_run": dry_run})
        return
    for file in found.kept:
        click.echo(f"{printable(file)}: {'would be ' if dry_run else ''}kept, it is no part of a dataset")
    click.echo(f"{printable(str(found.dataset))}: {what} {'would be ' if dry_run else ''}deleted")


def _print(datasets: "list[Derived]", *, as_json: bool, dry_run: bool) -> None:
    """Prints what was made, or would be."""
    if as_json:
        rows = list(map(dataclasses.asdict, datasets))
        print_json({"dry_run": dry_run, "datasets": rows})
        return
    for made in datasets:
        steps = made.steps
        span = f"step {steps[0]:,}" if len(steps) == 1 else f"steps {steps[0]:,} to {steps[-1]:,}"
        cut = f", {made.cut:,} of them cut" if made.cut else ""
        root = f"; root {made.root[:12]}" if made.root else ""
        would = "would have " if dry_run else ""
        click.echo(
            f"{printable(str(made.out))}: {would}{made.parts:,} parts{cut}, {made.tasks:,} tasks, {span}, "
            f"{size(made.bytes)}{root}, derived from {', '.join(source[:12] for source in made.sources)}"
        )
