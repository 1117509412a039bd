"""`tcmrl report`: tables, figures and verdicts from finished runs."""

import dataclasses
from pathlib import Path

import click

from .frame import output_options, print_json, remark
from .progress import StageProgress


@click.command()
@click.argument("runs", metavar="RUNS...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Where the report is written; the folder `report` in the first of RUNS if left out.",
)
@click.option(
    "--dataset",
    "datasets",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    multiple=True,
    help="A dataset that has moved since RUNS were trained on it; may be repeated.",
)
@output_options
def report(
    runs: tuple[Path, ...], out: Path | None, datasets: tuple[Path, ...], as_json: bool, quiet: bool
) -> None:
    """Write a report on RUNS: results folders of `tcmrl experiment`, or run folders of `tcmrl train`.

    report.md holds learning curves, final returns, what the contexts look like (t-SNE) and what the
    attention rests on, time and memory, the dataset's returns, the paper's figures where the unit is the
    same, and for each claim of an experiment whether the seeds support it, contradict it or cannot tell.
    Intervals (95%, bootstrap) come from five seeds or more; fewer seeds are printed themselves. Every
    table is also a CSV file, every figure a PNG file. Run folders are evaluated anew.

    \b
    Examples:
      tcmrl report results/figure5
      tcmrl report results/figure5 results/figure10 --out docs/results/ablations
      tcmrl report runs/point-robot-tcmrl-seed0 --out report
      tcmrl report results/figure5 --dataset /disk/point-robot
    """
    from tcmrl_algo import write_report

    with StageProgress(quiet=quiet) as progress:
        written = write_report(
            runs,
            out or runs[0] / "report",
            datasets=datasets,
            report=lambda stage, done, total: progress.update(stage, done=done, total=total, unit="parts"),
        )
    if as_json:
        document = dataclasses.asdict(written)
        print_json(document | {"report": str(written.report), "files": [str(each) for each in written.files]})
        return
    for verdict in written.verdicts:
        click.echo(f"{verdict.verdict}: {verdict.claim} ({verdict.environment})")
    click.echo(f"{written.report}: {len(written.files) - 1} tables and figures beside it")
    remark(
        "Verdicts compare seed by seed: supported or contradicted where 0 lies outside the interval.",
        quiet=quiet,
    )
