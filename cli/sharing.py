"""`tcmrl-data export` and `card`: a dataset for other libraries, for people and for hubs."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import size

from .frame import QUIET_OPTION, output_options, print_json, remark, stopped_by_signals
from .looking import NOTHING_KEPT
from .options import (
    DATASET,
    DRY_RUN,
    FILE,
    FORMAT_NAME,
    PATH,
    SNAPSHOTS,
    SPLIT,
    TASKS,
    TIER,
    beside,
    indices,
)
from .progress import PartsProgress, StageProgress, with_progress

if TYPE_CHECKING:
    from tcmrl_data.envs.base import Split


@click.command()
@DATASET
@click.option("--format", "format_name", required=True, type=FORMAT_NAME, help="Format of what is written.")
@click.option("--out", type=PATH, metavar="FOLDER", show_default="DATASET-FORMAT", help="Folder to create.")
@TASKS
@SPLIT
@TIER
@SNAPSHOTS
@DRY_RUN
@output_options
def export(
    dataset: Path,
    format_name: str,
    out: Path | None,
    tasks: str | None,
    split: "Split | None",
    tier: str | None,
    snapshots: str,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Export DATASET, or some of its tasks and snapshots, to another format.

    DATASET is the dataset's folder, its manifest.json or a view. Every task becomes one file or one folder
    in a new folder, which appears when all are complete. A stopped export goes on when the command is run
    again.

    \b
    Examples:
      tcmrl-data export data/point-robot --format hdf5 --snapshots last
      tcmrl-data export data/point-robot --format parquet --tier expert
      tcmrl-data export data/point-robot --format idaq-npy --dry-run
      tcmrl-data export data/point-robot --format minari --out minari
      MINARI_DATASETS_PATH=minari minari list local
    """
    import tcmrl_data

    opened = tcmrl_data.open_dataset(dataset)
    target = out or beside(opened.path, f"-{format_name}")
    with stopped_by_signals(lambda: NOTHING_KEPT), StageProgress() as progress:
        report = tcmrl_data.export_dataset(
            opened,
            format_name,
            target,
            tasks=indices(tasks),
            split=split,
            tier=tier,
            snapshots=snapshots,
            dry_run=dry_run,
            progress=lambda done, total: progress.update("export", done=done, total=total, unit="parts"),
        )
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


@click.command()
@DATASET
@click.option(
    "--format",
    "form",
    type=click.Choice(["readme", "bibtex", "cff", "croissant"]),
    default="readme",
    show_default=True,
    help="A README, a citation (BibTeX, Citation File Format 1.2), or Croissant 1.0.",
)
@click.option(
    "--out",
    type=PATH,
    metavar="PATH",
    show_default="standard output; of croissant the dataset, with --viewer its README.md",
    help="File to write, such as README.md; of croissant a folder.",
)
@click.option(
    "--viewer",
    is_flag=True,
    help="Beside the README, write Parquet that Hugging Face shows and load_dataset reads.",
)
@QUIET_OPTION
def card(dataset: Path, form: str, out: Path | None, viewer: bool) -> None:
    """Write the README of DATASET, how to cite it, or its description for search engines.

    The README says what the dataset is, how it was made, returns, tiers, limits, licence and citation. It
    begins with front matter that hubs of datasets read; what you wrote between its marks stays.

    A citation names the dataset, the works that its environment is from, and this software. Authors, URL, DOI
    and references are those of [about] in the recipe. The version is the beginning of the root, so that equal
    data have an equal version.

    With --viewer, the folder viewer/ beside the README holds transitions, episodes, parts and tasks as
    Parquet, training and test tasks apart, and the front matter names them.

    croissant.json and its two tables, a line per task and a line per part, are read by programs that search
    for data.

    \b
    Examples:
      tcmrl-data card data/point-robot --out data/point-robot/README.md
      tcmrl-data card data/point-robot --viewer
      tcmrl-data card data/point-robot --format bibtex
      tcmrl-data card data/point-robot --format croissant
    """
    import tcmrl_data
    from tcmrl_data.describe.card import BEGIN, dataset_card, write_card
    from tcmrl_data.describe.cite import citation_text
    from tcmrl_data.describe.croissant import write_croissant

    if viewer and form != "readme":
        raise click.UsageError(f"--viewer belongs to the README, not to --format {form}")
    opened = tcmrl_data.open_dataset(dataset)
    if out is None and opened.path != opened.folder and (viewer or form == "croissant"):
        kind = "a README.md" if viewer else "one"
        raise click.UsageError(f"{dataset} is no folder; name {kind} by --out")
    if viewer and out is None:
        out = opened.folder / "README.md"
    if form == "croissant":
        file = write_croissant(opened, out)
        click.echo(f"{printable(str(file))}: {len(opened.tasks):,} tasks, {len(opened.parts):,} parts")
        return
    if out is not None:
        FILE.convert(out, None, None)
    if form == "readme" and out is not None:
        file = out

        def work(progress: PartsProgress) -> None:
            write_card(opened, file, viewer=viewer, progress=progress)

        with_progress(work, stage="viewer", out=file.parent) if viewer else write_card(opened, file)
        remark(f"what you write below {BEGIN!r} stays when it is written again")
    else:
        text = dataset_card(opened) if form == "readme" else citation_text(opened.manifest, form)  # type: ignore[arg-type] # click checked it
        if out is None:
            click.echo(text, nl=False)
            return
        out.write_text(text, encoding="utf-8")
    click.echo(f"{printable(str(out))} written")
