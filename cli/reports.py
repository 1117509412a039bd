"""`tcmrl report` and `runs`: what finished runs say, and which runs there are."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from .frame import number, output_options, print_json, print_rows, remark
from .options import PATH
from .progress import StageProgress


@click.command()
@click.argument("runs", metavar="RUNS...", nargs=-1, required=True, type=PATH)
@click.option(
    "--out",
    type=PATH,
    metavar="FOLDER",
    show_default="report in the first of RUNS; of a table its folder",
    help="Folder of the report.",
)
@click.option(
    "--rows",
    type=PATH,
    metavar="FILE",
    help="Also add the runs to this table of results, such as results/runs.csv.",
)
@click.option(
    "--dataset",
    "datasets",
    type=PATH,
    metavar="FOLDER",
    multiple=True,
    help="Folder of a dataset that was moved after the training of RUNS; repeatable.",
)
@output_options
def report(
    runs: tuple[Path, ...], out: Path | None, rows: Path | None, datasets: tuple[Path, ...], as_json: bool
) -> None:
    """Write a report on experiments.

    RUNS are results folders of `tcmrl experiment`.

    report.md contains final returns, learning curves, t-SNE plots of contexts, attention weights, time and
    memory, returns of the dataset, and a verdict on every claim under every protocol: supported,
    contradicted, or cannot tell, corrected for the number of verdicts. From five runs on, 95% intervals are
    printed; with fewer, the values of all. report.html is the same in one file with its figures. Every table
    is also a CSV file and every figure a PNG file.

    With --rows, a table of results gets a row per run and protocol, under the name of the results folder;
    rows of the same runs are replaced. Tunings of `tcmrl tune` (folders) and documents of
    `tcmrl-data inspect worth --json` (files) can be added to tables of their own; no report is written of
    them.

    Where RUNS is such a table, its page is written: README.md, by README.md.jinja beside the table, or with
    a board of every experiment and environment. Tables named curves.csv, tuning.csv and worth.csv beside it
    are read too.

    \b
    Examples:
      tcmrl report results/perspectives
      tcmrl report results/perspectives results/window_length --out both
      tcmrl report results/perspectives --rows results/runs.csv
      tcmrl report tuning/point-robot-tcmrl --rows results/tuning.csv
      tcmrl report results/runs.csv
    """
    from tcmrl_algo import write_report

    if runs[0].suffix == ".csv":
        _write_page(runs, out, rows, as_json=as_json)
        return
    if rows is not None and (runs[0].suffix == ".json" or (runs[0] / "tuning.json").is_file()):
        _add(runs, rows, as_json=as_json)
        return
    with StageProgress() as progress:
        written = write_report(
            runs,
            out or runs[0] / "report",
            datasets=datasets,
            rows=rows,
            report=lambda stage, done, total: progress.update(stage, done=done, total=total, unit="parts"),
        )
    if as_json:
        document = dataclasses.asdict(written)
        print_json(document | {"report": str(written.report), "files": [str(file) for file in written.files]})
        return
    for verdict in written.verdicts:
        place = ", ".join(filter(None, (verdict.environment, verdict.protocol)))
        click.echo(f"{verdict.verdict}: {verdict.claim} ({place})")
    click.echo(f"{written.report}: written, with {len(written.files) - 1} other files")
    if rows is not None:
        click.echo(f"{rows}: the runs are in it; `tcmrl report {rows}` writes its page")
    remark("Verdicts compare methods run by run, corrected for the number of verdicts by Holm's method.")


def _write_page(tables: tuple[Path, ...], out: Path | None, rows: Path | None, *, as_json: bool) -> None:
    from tcmrl_algo import write_results_page

    if len(tables) > 1 or rows is not None:
        raise click.UsageError("A page is written of one table; name it alone.")
    files = [str(file) for file in write_results_page(tables[0], out)]
    if as_json:
        print_json({"report": files[0], "files": files})
    else:
        click.echo(f"{files[0]}: written, with {len(files) - 1} other files")


def _add(sources: tuple[Path, ...], rows: Path, *, as_json: bool) -> None:
    """Adds tunings, or documents of what a context is worth, to a table."""
    from tcmrl_algo import add_tunings, add_worth

    added = len(add_worth(rows, sources) if sources[0].suffix == ".json" else add_tunings(rows, sources))
    if as_json:
        print_json({"table": str(rows), "rows": added})
    else:
        click.echo(f"{rows}: {added} rows written")


@click.command()
@click.argument("folder", type=PATH, required=False)
@click.option(
    "--metric",
    "metrics",
    metavar="NAME",
    multiple=True,
    default=["watch/return"],
    show_default=True,
    help="Column of the last value of a training metric, such as loss/critic; repeatable.",
)
@output_options
def runs(folder: Path | None, metrics: tuple[str, ...], as_json: bool) -> None:
    """Compare the runs in FOLDER (default: runs) and its subfolders.

    `watch/return` is that of `tcmrl train --watch`; the last return is that of the last `tcmrl evaluate`.
    --json has all metrics.

    \b
    Examples:
      tcmrl runs
      tcmrl runs --metric watch/return --metric loss/critic
      tcmrl runs results/perspectives --json
    """
    from tcmrl_algo.training.checkpoint import list_runs

    if folder is not None and not folder.is_dir():
        raise click.ClickException(f"{folder} is not a folder; name a folder that contains runs")
    folder = folder or Path("runs")
    rows = list_runs(folder)
    if as_json:
        print_json({"runs": rows})
        return
    if not rows:
        remark(f"no runs in {folder}; train one with `tcmrl train DATASET`")
        return
    print_rows(
        f"Runs in {folder}",
        ["run", "trained", "steps", "dataset", *metrics, "last return"],
        [_cells(row, metrics) for row in rows],
        text=["run", "dataset"],  # a run's name is never folded: it is copied
        long_text=["trained"],
    )


def _cells(row: dict[str, Any], metrics: Sequence[str]) -> tuple[str, ...]:
    if "error" in row:
        return row["path"], f"unreadable: {row['error']}"
    evaluation = row["evaluation"]
    return (
        row["path"],
        f"{row['algorithm']} on {row['environment']}, seed {row['seed']}",
        f"{row['step']:,}/{row['steps']:,}",
        row["root"][:12],
        *(f"{row['metrics'][name]:.4g}" if name in row["metrics"] else "–" for name in metrics),
        f"{evaluation['protocol']} {number(evaluation['final'])}" if evaluation else "–",
    )
