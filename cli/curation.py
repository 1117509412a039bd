"""`tcmrl-data derive`: datasets made of datasets."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.foundation.errors import TierError
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.foundation.sizes import size

from .frame import fail_incomplete, output_options, print_json, remark, same_command, stopped_by_signals
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import Derived

TIERS = ("random", "medium", "medium-replay", "expert", "medium-expert", "random-expert", "mixed")
SOURCE = click.argument("dataset", type=click.Path(path_type=Path))
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
    from tcmrl_data.curation.derive import describe_far

    def make(progress: Callable[[int, int], None]) -> "Derived":
        return tcmrl_data.derive_dataset(
            dataset,
            out,
            view=view,
            tier=tier,
            snapshots=snapshots,
            tasks=None if tasks is None else tcmrl_data.parse_indices(tasks, tcmrl_data.MAX_TASKS),
            split="train" if split == "train" else "test" if split else None,
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
        made = _run(make, out or Path(), "derive", quiet=quiet)
    except TierError as error:
        fail_incomplete(f"{error}; choose another tier, or a larger --tolerance")
        return
    if made.far_from_medium:
        remark(f"warning: not near a score of 33: {describe_far(made.far_from_medium)}", quiet=quiet)
    _print([made], as_json=as_json, dry_run=dry_run)


def _run(make: "Callable[[Callable[[int, int], None]], Any]", out: Path, stage: str, *, quiet: bool) -> Any:
    """Calls a function of the package with progress; Ctrl-C says how to go on."""
    with stopped_by_signals(lambda: same_command(out)), StageProgress(quiet=quiet) as progress:
        return make(lambda done, total: progress.update(stage, done=done, total=total, unit="parts"))


def _print(datasets: "list[Derived]", *, as_json: bool, dry_run: bool) -> None:
    """Prints what was made, or would be."""
    if as_json:
        rows = [dataclasses.asdict(made) | {"out": str(made.out)} for made in datasets]
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
