"""`tcmrl report`: write tables, figures and verdicts on finished runs."""

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
    show_default="report in the first of RUNS; of an earlier report itself",
    help="Folder of the report.",
)
@click.option(
    "--dataset",
    "datasets",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    multiple=True,
    help="Folder of a dataset that was moved after the training of RUNS; repeatable.",
)
@output_options
def report(
    runs: tuple[Path, ...], out: Path | None, datasets: tuple[Path, ...], as_json: bool, quiet: bool
) -> None:
    """Write a report on finished runs.

    RUNS are results folders of `tcmrl experiment`, run folders of `tcmrl train`, or earlier reports.

    report.md contains final returns, learning curves, t-SNE plots of contexts, attention weights, time
    and memory, the returns of the dataset, the paper's numbers that have the same unit, and a verdict on
    every claim of an experiment under every protocol: supported, contradicted, or cannot tell, after a
    correction for the number of verdicts. From five runs on, 95% intervals are printed; with fewer, the
    values of all. Every table is also written as a CSV file and every figure as a PNG file. Run folders
    are evaluated first.

    Beside the report stand a small JSON document per run and what was measured of checkpoints and
    datasets. They are enough to write the same report again, elsewhere and later.

    \b
    Examples:
      tcmrl report results/figure5
      tcmrl report results/figure5 results/figure10 --out docs/results/ablations
      tcmrl report docs/results/ablations
      tcmrl report runs/point-robot-tcmrl-seed0 --out report
      tcmrl report results/figure5 --dataset /disk/point-robot
    """
    from tcmrl_algo import write_report

    with StageProgress(quiet=quiet) as progress:
        written = write_report(
            runs,
            out or _default_out(runs[0]),
            datasets=datasets,
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
    remark(
        "Verdicts compare methods run by run, corrected for the number of verdicts by Holm's method.",
        quiet=quiet,
    )


def _default_out(folder: Path) -> Path:
    return folder if (folder / "report.md").is_file() else folder / "report"
