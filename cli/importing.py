"""`tcmrl-data import`: make a dataset from the files of another program."""

import dataclasses
from pathlib import Path
from typing import Any

import click

from .frame import output_options, print_json, remark
from .plugins import READER
from .progress import with_progress


@click.command(name="import")
@click.argument("format_name", metavar="FORMAT", type=READER)
@click.argument("files", metavar="FILE…", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, metavar="DATASET", help="Folder to create."
)
@click.option(
    "--environment",
    metavar="NAME",
    show_default="foreign",
    help="Environment that the episodes come from; its sizes and horizon are compared.",
)
@click.option(
    "--task",
    type=click.IntRange(min=0),
    metavar="N",
    show_default="the files' own, or 0",
    help="Task of the first FILE; further ones count on.",
)
@click.option(
    "--tasks",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help='JSON list of {"index", "split", "parameters"}: what the files do not say of tasks.',
)
@click.option("--option", "options", multiple=True, metavar="NAME=VALUE", help="Option of the format.")
@click.option("--label", help="The dataset's own name.")
@click.option("--licence", help="SPDX licence of the data, recorded as their origin.")
@click.option("--url", help="Where the data come from, recorded as their origin.")
@click.option("--dry-run", is_flag=True, help="Read and check the files only.")
@output_options
def import_data(
    format_name: str,
    files: tuple[Path, ...],
    out: Path,
    environment: str | None,
    task: int | None,
    tasks: Path | None,
    options: tuple[str, ...],
    label: str | None,
    licence: str | None,
    url: str | None,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a dataset from FILE… of FORMAT.

    Files are read without running code of them, and without reading other files. What they do not say
    stays open: seeds, policies and reference returns. A stopped import goes on when the command is run again.

    \b
    Examples:
      tcmrl-data import hdf5 hopper_medium.hdf5 --out data/hopper
      tcmrl-data import hdf5 demo.hdf5 --option layout=robomimic --out data/lift --dry-run
      tcmrl-data import minari ~/.minari/datasets/D4RL/door/human-v2 --out data/door
      tcmrl-data import idaq-npy data/cheetah-vel --environment half-cheetah-vel --out data/published
    """
    import tcmrl_data

    report = with_progress(
        lambda progress: tcmrl_data.import_dataset(
            format_name,
            files,
            out,
            environment=environment,
            task=task,
            tasks=tasks,
            options=dict(map(_option, options)),
            label=label,
            licence=licence,
            url=url,
            dry_run=dry_run,
            progress=progress,
        ),
        stage="import",
        out=out,
        quiet=quiet,
    )
    if as_json:
        print_json(dataclasses.asdict(report) | {"out": out})
        return
    for note in report.notes:
        remark(note, quiet=quiet)
    counts = f"{report.tasks:,} tasks, {report.parts:,} parts, {report.episodes:,} episodes"
    sizes = f"observations {report.observation_dim}, actions {report.action_dim}, horizon {report.horizon}"
    end = "nothing written" if report.root is None else f"root {report.root[:12]}"
    click.echo(f"{out}: {report.environment}, {counts} with {report.steps:,} steps, {sizes}; {end}")


def _option(text: str) -> tuple[str, Any]:
    """A name and its value: an integer where it looks like one, else text."""
    name, equals, value = text.partition("=")
    if not equals:
        raise click.UsageError(f"--option {text!r}: expected NAME=VALUE")
    return name, int(value) if value.isdecimal() else value
