"""`tcmrl-data diff`."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.plain_files import printable

from .frame import INCOMPLETE, output_options, print_json
from .places import DATASET_PATH

if TYPE_CHECKING:
    from tcmrl_data import DatasetDiff, DiffLevel

MOST_LINES = 8
"""Lines of one kind that are printed; `--json` has all."""


@click.command()
@click.argument("left", type=DATASET_PATH)
@click.argument("right", type=DATASET_PATH)
@click.option(
    "--level",
    type=click.Choice(["manifest", "statistics", "arrays"]),
    default="statistics",
    show_default=True,
    help="How deep to read: manifests and tables, records of parts, or the first part that differs.",
)
@output_options
def diff(left: Path, right: Path, level: "DiffLevel", as_json: bool, quiet: bool) -> None:
    """Say what differs between the datasets LEFT and RIGHT, and why.

    Of the first part that differs, the first cause is named: data version, settings, seed, task parameters,
    derivation, policy, or arrays. The exit code is 0 for equal roots and 1 for others.

    \b
    Examples:
      tcmrl-data diff data/point-robot copy/point-robot
      tcmrl-data diff data/seed0 data/seed1 --level arrays --json
    """
    import tcmrl_data

    found = tcmrl_data.diff_datasets(left, right, level=level)
    if as_json:
        document = dataclasses.asdict(found) | {"left": str(found.left), "right": str(found.right)}
        print_json(document | {"same_root": found.same_root, "is_empty": found.is_empty})
    else:
        for line in _lines(found):
            click.echo(printable(line))
    if not found.same_root:
        click.get_current_context().exit(INCOMPLETE)


def _lines(found: "DatasetDiff") -> Iterator[str]:
    roots = [root[:12] for root in found.roots]
    if found.is_empty:
        yield f"equal: root {roots[0]}, {found.equal:,} parts"
        return
    yield (
        f"root          {roots[0]} → {roots[1]}"
        if not found.same_root
        else f"root          {roots[0]}, equal"
    )
    for title, changes in (
        ("recipe", found.recipe),
        ("runs", found.runs),
        ("platforms", found.platforms),
        ("tasks", found.tasks),
    ):
        for change in changes[:MOST_LINES]:
            yield f"{title:<13} {change.name}  {_value(change.left)} → {_value(change.right)}"
        if len(changes) > MOST_LINES:
            yield f"{title:<13} and {len(changes) - MOST_LINES:,} more"
    counts = (found.equal, len(found.different), len(found.left_only), len(found.right_only))
    yield "parts         {:,} equal, {:,} differ, {:,} left only, {:,} right only".format(*counts)
    if found.returns is not None:
        of = found.returns
        ends = "" if of.low is None else f", 95% {of.low:.3g} to {of.high:.3g} (Welch, over tasks)"
        yield f"returns       {of.left:.4g} → {of.right:.4g}, difference {of.difference:.3g}{ends}"
    if found.observations is not None:
        seen = found.observations
        shift = "" if seen.shift is None else f", {seen.shift:.2g} standard deviations"
        yield f"observations  column {seen.column}: mean {seen.left:.4g} → {seen.right:.4g}{shift}"
    if found.first is not None:
        yield f"first         {found.first.key}: {found.first.stage}: {found.first.detail}"
        if found.first.platform:
            yield f"              made on other platforms: {'; '.join(found.first.platform)}"


def _value(value: object) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
