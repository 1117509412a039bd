"""`tcmrl-data show`: print a summary of a dataset and the next commands."""

from pathlib import Path
from typing import Any

import click

from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable

from .frame import make_table, output_options, print_json, print_table, remark
from .places import DATASET_PATH


@click.command()
@click.argument("dataset", type=DATASET_PATH)
@output_options
def show(dataset: Path, as_json: bool, quiet: bool) -> None:
    """Print a summary of DATASET.

    The summary contains recipe, tasks, sizes and root of the dataset, and software and CPU of its build.

    \b
    Examples:
      tcmrl-data show data/point-robot
      tcmrl-data show data/point-robot --json
    """
    import tcmrl_data
    from tcmrl_data.dataset.listing import dataset_summary

    opened = tcmrl_data.open_dataset(dataset)
    document = dataset_summary(opened)
    if as_json:
        print_json(document)
        return
    title = printable(str(opened.path))
    table = make_table(title, columns=["property", "value"], text=["property"], long_text=["value"])
    for name, value in _rows(document).items():
        table.add_row(name, printable(value))
    print_table(table)
    for command in _next_commands(opened.path, document):
        remark(f"Next: {command}", quiet=quiet)


def _rows(document: dict[str, Any]) -> dict[str, str]:
    made, steps = document["made_with"], document["snapshots"]
    state = "complete" if document["complete"] else "incomplete"
    rows = {
        "environment": f"{document['name']}: {document['description']}",
        "recipe": f"profile {document['profile']}, behavior {document['behavior']}, seed {document['seed']}",
        "tasks": f"{document['tasks']:,} ({document['train']:,} train, {document['test']:,} test)",
        "snapshots": f"{len(steps):,} per task, at steps {', '.join(f'{step:,}' for step in steps)}",
        "parts": f"{document['parts']:,} of {document['parts_total']:,}: {state}",
        "episodes": f"{document['episodes']:,} with {document['steps']:,} steps",
        "size": size(document["bytes"]),
        "root": document["root"],
    }
    labels = {"cpu": "CPU", "system": "system", "packages": "packages"}
    return rows | {label: "; ".join(made[key]) for key, label in labels.items() if made[key]}


def _next_commands(folder: Path, document: dict[str, Any]) -> list[str]:
    if not document["complete"]:
        return [f"run the `tcmrl-data build {document['name']}` command of this dataset again"]
    return [f"tcmrl-data inspect returns {folder}", f"tcmrl-data verify {folder}", f"tcmrl train {folder}"]
