"""`tcmrl-data export`: write a dataset, or some of it, in the format of another library."""

from pathlib import Path

import click

from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable

from .curation import DRY_RUN, TIERS
from .frame import output_options, print_json
from .places import DATASET_PATH
from .plugins import FORMAT
from .progress import PartsProgress, with_progress


@click.command()
@click.argument("dataset", type=DATASET_PATH)
@click.option("--format", "format_name", required=True, type=FORMAT, help="Export format.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    show_default="DATASET-FORMAT",
    help="Folder to create.",
)
@click.option("--tasks", metavar="LIST", help="Only these tasks, such as 0-9,12.")
@click.option("--split", type=click.Choice(["train", "test"]), help="Only tasks of this split.")
@click.option("--tier", type=click.Choice(TIERS), metavar="NAME", help=f"Quality tier: {', '.join(TIERS)}.")
@click.option(
    "--snapshots",
    default="all",
    show_default=True,
    metavar="RULE",
    help="Instead of a tier: all, last, steps>=N, return>=Q with a quantile Q, or tier:NAME.",
)
@DRY_RUN
@output_options
def export(
    dataset: Path,
    format_name: str,
    out: Path | None,
    tasks: str | None,
    split: str | None,
    tier: str | None,
    snapshots: str,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Export DATASET, or some of its tasks and snapshots, to another format.

    DATASET is the dataset's folder, its manifest.json or a view. Every task becomes one file or one folder
    in a new folder, which appears when all are complete. A stopped export goes on when the command is run
    again.

    \b
    Examples:
      tcmrl-data export data/point-robot --format hdf5 --snapshots last
      tcmrl-data export data/point-robot --format parquet --split train --tier expert
      tcmrl-data export data/point-robot --format idaq-npy --out published --dry-run
      tcmrl-data export data/point-robot --format minari --out minari
      MINARI_DATASETS_PATH=minari minari list local
    """
    import tcmrl_data
    from tcmrl_data.interchange.exporting import staging_folder

    opened = tcmrl_data.open_dataset(dataset)
    place = opened.path if opened.path.name not in ("", "..") else opened.path.resolve()
    target = out or place.with_name(f"{place.stem if place.is_file() else place.name}-{format_name}")

    def work(progress: PartsProgress) -> tcmrl_data.ExportReport:
        return tcmrl_data.export_dataset(
            opened,
            format_name,
            target,
            tasks=None if tasks is None else tcmrl_data.parse_indices(tasks, tcmrl_data.MAX_TASKS),
            split="train" if split == "train" else "test" if split else None,
            tier=tier,
            snapshots=snapshots,
            dry_run=dry_run,
            progress=progress,
        )

    report = with_progress(work, stage="export", out=staging_folder(target), quiet=quiet)
    num_bytes = sum(file.stat().st_size for file in report.files)
    if as_json:
        print_json(
            {
                "format": format_name,
                "out": str(target),
                "dry_run": dry_run,
                "tasks": report.tasks,
                "parts": report.parts,
                "episodes": report.episodes,
                "steps": report.steps,
                "files": [str(file) for file in report.files],
                "bytes": num_bytes,
            }
        )
        return
    counts = f"{report.tasks:,} tasks, {report.parts:,} parts, {report.episodes:,} episodes"
    end = "nothing written" if dry_run else f"{len(report.files):,} files, {size(num_bytes)}"
    click.echo(f"{printable(str(target))}: {counts} with {report.steps:,} steps; {end}")
