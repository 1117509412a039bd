"""`tcmrl-data`: make, look at, change, keep and share datasets."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import size

from .changing import derive, extend, merge, relabel
from .frame import (
    duration,
    main_program,
    next_commands,
    output_options,
    print_json,
    print_properties,
    print_rows,
    remark,
)
from .groups import SETTINGS, Commands
from .inspection import inspect
from .keeping import cache, delete, verify
from .looking import dataset_report, diff, render
from .making import build, import_data
from .new import new
from .options import DATASET, DATASET_PATH
from .remote import pull, push
from .sharing import card, export

if TYPE_CHECKING:
    from tcmrl_data import BuildStatus


def main() -> None:
    """Entry point of the console script."""
    main_program(data)


@click.group(name="tcmrl-data", cls=Commands, context_settings=SETTINGS)
@click.version_option(package_name="tcmrl")
def data() -> None:
    """Make, look at, change and share datasets for offline meta-reinforcement learning.

    \b
    Examples:
      tcmrl-data build point-robot --profile quick --plan
      tcmrl-data build point-robot --profile quick
      tcmrl-data inspect returns data/point-robot --plot returns.png

    Exit codes: 0 success, 1 failed check or incomplete work, 2 bad usage or bad input.
    """


@click.command()
@output_options
def envs(as_json: bool) -> None:
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
    rows = [[str(row[key]) for key in heads] for row in found.environments]
    print_rows("Environments", heads.values(), rows, text=["environment"])
    for error in found.broken.values():
        click.echo(f"broken: {error}")


@click.command(name="list")
@click.argument("folder", type=DATASET_PATH, required=False)
@output_options
def list_(folder: Path | str | None, as_json: bool) -> None:
    """List the datasets and views in FOLDER (default: data) and its subfolders.

    FOLDER may be an address, such as a bucket: then each dataset is listed, and each of its tags.

    \b
    Examples:
      tcmrl-data list data --json
      tcmrl-data list s3://bucket
    """
    import tcmrl_data

    if isinstance(folder, Path) and not folder.is_dir():
        raise click.ClickException(f"{folder} is not a folder; name a folder that contains datasets")
    folder = folder or Path("data")
    rows = tcmrl_data.list_datasets(folder)
    if as_json:
        print_json({"datasets": rows})
        return
    if not rows:
        remark(f"no datasets in {folder}; build one with `tcmrl-data build ENV`")
        return
    print_rows(
        f"Datasets in {folder}",
        ["dataset", "contents", "tasks", "parts", "root"],
        map(_cells, rows),
        text=["root"],
        long_text=["dataset", "contents"],
    )


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """A dataset's folder, what it is called and was made by, its state and its sizes."""
    if "error" in row:
        return row["path"], f"unreadable: {row['error']}"
    made = [row["label"], row["name"], row["profile"], row["behavior"], f"seed {row['seed']}"]
    view = f"view of {row['source']}" if row["source"] else None
    state = "complete" if row["complete"] else "incomplete"
    contents = printable(", ".join(filter(None, [*made, row["derived"], view, state])))
    return row["path"], contents, f"{row['tasks']:,}", f"{row['parts']:,}", row["root"][:12]


@click.command()
@DATASET
@output_options
def show(dataset: Path, as_json: bool) -> None:
    """Print a summary of DATASET, and the progress of its build, during the build or after it.

    The summary contains recipe, tasks, sizes and root of the dataset, and software and CPU of its build.

    \b
    Examples:
      tcmrl-data show data/point-robot --json
      watch tcmrl-data show data/half-cheetah-vel
    """
    import tcmrl_data
    from tcmrl_data.dataset.listing import dataset_summary

    opened = tcmrl_data.open_dataset(dataset)
    document = dataset_summary(opened)
    status = tcmrl_data.build_status(opened.folder) if opened.path == opened.folder else None
    if as_json:
        print_json(document | {"build": None if status is None else dataclasses.asdict(status)})
        return
    rows = _summary(document)
    if status is not None and (status.builder or not document["complete"] or status.num_failed):
        rows |= _progress(status)
    values = {name: printable(value) for name, value in rows.items()}
    print_properties(printable(str(opened.path)), values)
    place = str(opened.path)
    if not document["complete"]:
        remark(f"Next: run the `tcmrl-data build {document['name']}` command of this dataset again")
    elif opened.remote is not None:
        next_commands(
            ["tcmrl-data", "inspect", "returns", place],
            ["tcmrl-data", "pull", place, "FOLDER"],
        )
    else:
        next_commands(
            ["tcmrl-data", "inspect", "returns", place],
            ["tcmrl-data", "verify", place],
            ["tcmrl", "train", place],
        )


def _summary(document: dict[str, Any]) -> dict[str, str]:
    made, steps = document["made_with"], document["snapshots"]
    rows = {
        "environment": f"{document['name']}: {document['description']}",
        "recipe": f"profile {document['profile']}, behavior {document['behavior']}, seed {document['seed']}",
        "tasks": f"{document['tasks']:,} ({document['train']:,} train, {document['test']:,} test)",
        "snapshots": f"{len(steps):,} per task, at steps {', '.join(f'{step:,}' for step in steps)}",
        "parts": f"{document['parts']:,} of {document['parts_total']:,}: "
        f"{'complete' if document['complete'] else 'incomplete'}",
        "episodes": f"{document['episodes']:,} with {document['steps']:,} steps",
        "size": size(document["bytes"]),
        "root": document["root"],
    }
    labels = {"cpu": "CPU", "system": "system", "packages": "packages"}
    return rows | {label: "; ".join(made[key]) for key, label in labels.items() if made[key]}


def _progress(status: "BuildStatus") -> dict[str, str]:
    """Rows on a build that runs, was stopped, or had failures."""
    rate, left, updated = status.steps_per_second, status.seconds_left, status.updated
    again = "stopped; run the same `tcmrl-data build` again to continue"
    ended = "complete" if status.complete else again
    rows = {
        "build": f"running: {status.builder}" if status.builder else ended,
        "published parts": f"{status.parts_done:,} of {status.parts_total:,}",
        "running": ", ".join(status.running) or "nothing",
        "rate": "unknown" if rate is None else f"{rate:,.0f} training steps/s",
        "time left": "unknown" if left is None else f"about {duration(left)}",
        "last update": "none" if updated is None else f"{duration(max(0.0, time.time() - updated))} ago",
    }
    if status.num_failed:
        latest = f"{status.num_failed:,} units, the latest {len(status.failed):,}: "
        rows["failed"] = latest + "; ".join(status.failed)
    return rows


data.fill(
    {
        "Make": [build, new, import_data],
        "Look": [envs, list_, show, inspect, diff, dataset_report, render],
        "Change": [derive, merge, extend, relabel],
        "Keep": [verify, delete, cache],
        "Share": [export, push, pull, card],
    }
)
