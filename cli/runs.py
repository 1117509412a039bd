"""`tcmrl runs`: list runs and their progress."""

from pathlib import Path
from typing import Any

import click

from .frame import make_table, number, output_options, print_json, print_table, remark


@click.command()
@click.argument("root", type=click.Path(path_type=Path), required=False)
@output_options
def runs(root: Path | None, as_json: bool, quiet: bool) -> None:
    """List the runs in the folder ROOT (default: runs) and its subfolders.

    \b
    Examples:
      tcmrl runs
      tcmrl runs results/perspectives --json
    """
    from tcmrl_algo.training.listing import list_runs

    if root is not None and not root.is_dir():
        raise click.ClickException(f"{root} is not a folder; name a folder that contains runs")
    root = root or Path("runs")
    rows = list_runs(root)
    if as_json:
        print_json({"runs": rows})
        return
    if not rows:
        remark(f"no runs in {root}; train one with `tcmrl train DATASET`", quiet=quiet)
        return
    table = make_table(
        f"Runs in {root}",
        columns=["run", "trained", "steps", "dataset", "last return"],
        text=["dataset"],
        long_text=["run", "trained"],
    )
    for row in rows:
        table.add_row(*_cells(row))
    print_table(table)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    if "error" in row:
        return row["path"], f"unreadable: {row['error']}", "", "", ""
    evaluation = row["evaluation"]
    return (
        row["path"],
        f"{row['algorithm']} on {row['environment']}, seed {row['seed']}",
        f"{row['step']:,}/{row['steps']:,}",
        row["root"][:12],
        f"{evaluation['protocol']} {number(evaluation['final'])}" if evaluation else "–",
    )
