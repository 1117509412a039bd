"""`tcmrl-data status`: print the progress of a build, from any process."""

import dataclasses
import time
from pathlib import Path

import click

from tcmrl_data.foundation.plain_files import printable

from .frame import duration, make_table, output_options, print_json, print_table
from .places import DATASET_PATH


@click.command()
@click.argument("dataset", type=DATASET_PATH)
@output_options
def status(dataset: Path, as_json: bool, quiet: bool) -> None:
    """Print the progress of the build of DATASET, during the build or after it.

    \b
    Examples:
      tcmrl-data status data/point-robot
      watch tcmrl-data status data/half-cheetah-vel
    """
    import tcmrl_data

    found = tcmrl_data.build_status(dataset)
    if as_json:
        print_json(dataclasses.asdict(found))
        return
    rate, left, updated = found.steps_per_second, found.seconds_left, found.updated
    if found.builder:
        state = f"being built by {found.builder}"
    else:
        state = (
            "complete" if found.complete else "incomplete; run the same `tcmrl-data build` again to continue"
        )
    rows = {
        "environment": found.environment,
        "state": state,
        "parts": f"{found.parts_done:,} of {found.parts_total:,}, {found.tasks:,} tasks",
        "running": ", ".join(found.running) or "nothing",
        "rate": "unknown" if rate is None else f"{rate:,.0f} training steps/s",
        "time left": "unknown" if left is None else f"about {duration(left)}",
        "last update": "none" if updated is None else f"{duration(max(0.0, time.time() - updated))} ago",
    }
    table = make_table(str(dataset), columns=["property", "value"], text=["property"], long_text=["value"])
    for name, value in rows.items():
        table.add_row(name, printable(value))
    for failure in found.failed:
        table.add_row("failed", printable(failure))
    if found.num_failed > len(found.failed):
        table.add_row("failed", f"{found.num_failed:,} units; these are the latest {len(found.failed):,}")
    print_table(table)
