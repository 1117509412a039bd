"""`tcmrl report`: write tables, figures and verdicts on finished runs, or a leaderboard of them."""

import dataclasses
from pathlib import Path

import click

from .frame import output_options, print_json, remark
from .places import RUN_PATH
from .progress import StageProgress


@click.command()
@click.argument("runs", metavar="RUNS...", nargs=-1, required=True, type=RUN_PATH)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    show_default="report or leaderboard in the first of RUNS; of an earlier report itself",
    help="Folder of the report.",
)
@click.option(
    "--leaderboard",
    is_flag=True,
    help="Write a leaderboard of all methods in RUNS instead of a report.",
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
    runs: tuple[Path, ...],
    out: Path | None,
    leaderboard: bool,
    datasets: tuple[Path, ...],
    as_json: bool,
    quiet: bool,
) -> None:
    """Write a report on finished runs.

    RUNS are results folders of `tcmrl experiment`, run folders of `tcmrl train`, or earlier reports.

    report.md contains final returns, learning curves, t-SNE plots of contexts, attention weights, time
    and memory, the returns of the dataset, the paper's numbers that have the same unit, and a verdict on
    every claim of an experiment under every protocol: supported, contradicted, or cannot tell, after a
    correction for the number of verdicts. From five runs on, 95% intervals are printed; with fewer, the
    values of all. report.html is the same report in one file with its figures in it. Every table is also
    written as a CSV file and every figure as a PNG file. Run folders are evaluated first.

    Beside the report stand a small JSON document per run and what was measured of checkpoints and
    datasets. They are enough to write the same report again, elsewhere and later.

    With --leaderboard, leaderboard.md contains the returns of every method in every environment under every
    protocol, mean ranks, budgets, costs, and who was tuned how. Only results on one dataset are ranked
    together. It needs the JSON documents of the runs alone.

    \b
    Examples:
      tcmrl report results/figure5
      tcmrl report results/figure5 results/figure10 --out docs/results/ablations
      tcmrl report docs/results/ablations
      tcmrl report results/table1 results/table2 --leaderboard --out docs/results/leaderboard
      tcmrl report runs/point-robot-tcmrl-seed0 --out report
      tcmrl report results/figure5 --dataset /disk/point-robot
    """
    from tcmrl_algo import write_leaderboard, write_report

    write = write_leaderboard if leaderboard else write_report
    default = runs[0] / "leaderboard" if leaderboard else _default_out(runs[0])
    with StageProgress(quiet=quiet) as progress:
        written = write(
            runs,
            out or default,
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
    if leaderboard:
        return
    remark(
        "Verdicts compare methods run by run, corrected for the number of verdicts by Holm's method.",
        quiet=quiet,
    )


def _default_out(folder: Path) -> Path:
    return folder if (folder / "report.md").is_file() else folder / "report"
