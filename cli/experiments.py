"""`tcmrl experiment`: many runs, one results folder, one table."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .frame import (
    duration,
    fail_incomplete,
    make_table,
    number,
    output_options,
    print_json,
    print_table,
    remark,
    same_command,
    stopped_by_signals,
)

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import ExperimentReport, Finished, RunResult

NUM_SEEDS = 10_000


@click.command()
@click.argument("name", metavar="FILE|NAME", required=False)
@click.option("--list", "as_list", is_flag=True, help="List the experiments that come with the package.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="The results folder; results/<name> if left out.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=Path("data"),
    show_default=True,
    metavar="FOLDER",
    help="Where the datasets lie, each in a folder named after its environment; or the one dataset.",
)
@click.option("--workers", type=click.IntRange(min=1), help="Runs at a time; one per core if left out.")
@click.option("--steps", type=click.IntRange(min=1), help="Training steps of every run, schedules included.")
@click.option("--seeds", metavar="LIST", help="Seeds such as 0-4 or 0,3, instead of the file's.")
@click.option(
    "--only", metavar="LABEL", multiple=True, help="Only the method of this label; may be repeated."
)
@click.option("--device", default="cpu", show_default=True, help="A torch device, such as cpu or cuda.")
@output_options
def experiment(
    name: str | None,
    as_list: bool,
    out: Path | None,
    data: Path,
    workers: int | None,
    steps: int | None,
    seeds: str | None,
    only: tuple[str, ...],
    device: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Run an experiment: its methods on its environments under its seeds, several at once.

    FILE is a TOML file; NAME is one that --list shows. Everything is checked before the first run starts.
    When the same command runs again, finished runs are kept and killed ones go on from their last
    checkpoint, and end as if they had never stopped. The cores are shared out among the workers.

    The folder holds one JSON document per run in runs/, and table.csv. Returns are undiscounted.

    \b
    Examples:
      tcmrl experiment --list
      tcmrl experiment tour --workers 2
      tcmrl experiment figure10 --workers 4 --seeds 0-2 --steps 1000 --out results/first-look
      tcmrl experiment mine.toml --data /disk/datasets --only TCMRL --only FOCAL
    """
    from tcmrl_algo import load_experiment, run_experiment
    from tcmrl_data import parse_indices

    if as_list:
        _print_list(as_json=as_json)
        return
    if name is None:
        raise click.UsageError("Name a FILE or an experiment that `tcmrl experiment --list` shows.")
    loaded = load_experiment(name)
    out = out or Path("results") / loaded.name
    with stopped_by_signals(lambda: same_command(out)):
        report = run_experiment(
            loaded,
            out,
            data=data,
            only=only,
            seeds=None if seeds is None else parse_indices(seeds, NUM_SEEDS, option="--seeds"),
            steps=steps,
            workers=workers,
            device=device,
            report=lambda event: remark(_line(event), quiet=quiet),
        )
    if as_json:
        print_json(_document(report))
    else:
        for environment in dict.fromkeys(each.environment for each in report.results):
            for table in result_tables(environment, report.results):
                print_table(table)
        ran = len(report.results) - report.present
        click.echo(
            f"{report.out}: {ran} runs done, {report.present} were there, in {duration(report.seconds)}"
        )
        if report.results:
            remark(f"Next: tcmrl report {report.out}", quiet=quiet)
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; the same command tries again what failed")


def _print_list(*, as_json: bool) -> None:
    from tcmrl_algo import experiment_names, load_experiment

    found = [load_experiment(name) for name in experiment_names()]
    if as_json:
        fields = {"name", "title", "source", "environments", "methods", "seeds", "protocols", "claims"}
        print_json({"experiments": [one.model_dump(mode="json", include=fields) for one in found]})
        return
    table = make_table(
        "Experiments", columns=["experiment", "asks", "runs"], text=["experiment"], long_text=["asks"]
    )
    for one in found:
        table.add_row(one.name, one.title, str(len(one.environments) * len(one.methods) * len(one.seeds)))
    print_table(table)


def _line(event: "Finished") -> str:
    left = f", about {duration(event.seconds_left)} left" if event.seconds_left else ""
    if event.result is None:
        return f"{event.done} of {event.total}: {event.id} failed: {event.error}{left}"
    result = event.result
    finals = ", ".join(f"{name} {number(each['mean_final'])}" for name, each in result.evaluations.items())
    return (
        f"{event.done} of {event.total}: {result.environment}, {result.method}, seed {result.seed}: "
        f"{finals}{left}"
    )


def _document(report: "ExperimentReport") -> dict[str, Any]:
    return {
        "results": str(report.out),
        "ran": len(report.results) - report.present,
        "present": report.present,
        "failed": list(report.failed),
        "seconds": round(report.seconds, 3),
        "rows": [row for result in report.results for row in result.rows()],
    }


def result_tables(environment: str, results: Sequence["RunResult"]) -> list["Table"]:
    """One table per protocol: what every method reaches across seeds, and under others' contexts."""
    from tcmrl_algo import by_method, summarize

    here = [result for result in results if result.environment == environment]
    columns = ("method", "seeds", "mean", "95%", "other", "regret")
    tables = []
    for protocol in here[0].evaluations:
        title = f"{environment}, protocol {protocol}: returns on the test tasks"
        table = make_table(title, columns=columns, long_text=("method",))
        for method, runs in by_method(here).items():
            rows = [row for result in runs for row in result.rows()]
            chosen = [row for row in rows if row["protocol"] == protocol]
            final = summarize([row["final"] for row in chosen])
            interval = "–" if final.low is None else f"{number(final.low)} to {number(final.high)}"
            other = summarize([row["shuffled"] for row in chosen]).mean
            regrets = [row["regret"] for row in chosen]
            regret = None if None in regrets else summarize(regrets).mean
            table.add_row(
                method, str(len(chosen)), number(final.mean), interval, number(other), number(regret)
            )
        tables.append(table)
    return tables
