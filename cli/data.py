"""`tcmrl-data`: plan, build, import, list, inspect, verify, repair and export datasets."""

import dataclasses
from pathlib import Path

import click

from .building import build, plan
from .cache import cache
from .card import card, cite, croissant, schema
from .completion import completion
from .curation import delete, derive, merge, rename, split
from .dataset_report import dataset_report
from .diff import diff
from .exporting import export
from .frame import main_program, make_table, output_options, print_json, print_table, remark
from .importing import import_data
from .inspection import inspect
from .quality import coverage, quality, rewards
from .recipes import recipe
from .remaking import extend, relabel
from .rendering import render
from .show import show
from .status import status
from .verification import gc, import_policy, repair, verify
from .worth import transfer, worth

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


def main() -> None:
    """Entry point of the console script."""
    main_program(data)


@click.group(name="tcmrl-data", context_settings=CONTEXT)
@click.version_option(package_name="tcmrl")
def data() -> None:
    """Build, inspect, verify and export datasets for offline meta-reinforcement learning.

    \b
    Examples:
      tcmrl-data plan point-robot --profile quick
      tcmrl-data build point-robot --profile quick
      tcmrl-data inspect returns data/point-robot --plot returns.png

    Exit codes: 0 success, 1 failed check or incomplete work, 2 bad usage or bad input.
    """


for _command in (
    recipe,
    plan,
    build,
    status,
    show,
    inspect,
    dataset_report,
    verify,
    repair,
    gc,
    import_data,
    import_policy,
    cache,
    derive,
    merge,
    split,
    rename,
    delete,
    diff,
    export,
    extend,
    relabel,
    render,
    completion,
    card,
    cite,
    croissant,
    schema,
):
    data.add_command(_command)


for _measure in (quality, coverage, transfer, rewards, worth):
    inspect.add_command(_measure)


@data.command()
@output_options
def envs(as_json: bool, quiet: bool) -> None:
    """List the environments that have a recipe, and the ones that cannot be loaded.

    \b
    Example:
      tcmrl-data envs --json
    """
    import tcmrl_data

    found = tcmrl_data.list_environments()
    if as_json:
        print_json(dataclasses.asdict(found))
        return
    heads = {
        "name": "environment",
        "observation_dim": "obs dim",
        "action_dim": "act dim",
        "horizon": "horizon",
        "tasks": "tasks",
        "train": "train",
        "test": "test",
    }
    table = make_table("Environments", columns=heads.values(), text=["environment"])
    for row in found.environments:
        table.add_row(*(str(row[key]) for key in heads))
    print_table(table)
    for error in found.broken.values():
        click.echo(f"broken: {error}")


@data.command(name="list")
@click.argument("root", type=click.Path(path_type=Path), required=False)
@output_options
def list_(root: Path | None, as_json: bool, quiet: bool) -> None:
    """List the datasets in the folder ROOT (default: data) and its subfolders.

    \b
    Example:
      tcmrl-data list data --json
    """
    import tcmrl_data

    if root is not None and not root.is_dir():
        raise click.ClickException(f"{root} is not a folder; name a folder that contains datasets")
    root = root or Path("data")
    rows = tcmrl_data.list_datasets(root)
    if as_json:
        print_json({"datasets": rows})
        return
    if not rows:
        remark(f"no datasets in {root}; build one with `tcmrl-data build ENV`", quiet=quiet)
        return
    table = make_table(
        f"Datasets in {root}",
        columns=["dataset", "built from", "tasks", "parts", "state", "root"],
        text=["root"],
        long_text=["dataset", "built from", "state"],
    )
    for row in rows:
        if "error" in row:
            table.add_row(row["path"], "", "", "", f"unreadable: {row['error']}", "")
            continue
        built_from = f"{row['name']}, {row['profile']}, {row['behavior']}, seed {row['seed']}"
        state = "complete" if row["complete"] else "incomplete"
        counts = (f"{row['tasks']:,}", f"{row['parts']:,}")
        table.add_row(row["path"], built_from, *counts, state, row["root"][:12])
    print_table(table)
