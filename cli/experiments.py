"""`tcmrl experiment`: do the runs of an experiment and print tables of their returns."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.recipe import PROFILES, Profile

from .building import show_build
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
from .options import DEVICE, SIMULTANEOUS_RUNS
from .places import complete_experiments
from .progress import StageProgress

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Experiment, ExperimentReport, RunResult

NUM_SEEDS = 10_000


@click.command()
@click.argument("name", metavar="FILE|NAME", required=False, shell_complete=complete_experiments)
@click.option("--list", "as_list", is_flag=True, help="List the experiments of this package.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    show_default="results/NAME",
    help="Folder of the results.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=Path("data"),
    show_default=True,
    metavar="FOLDER",
    help="Folder that contains a dataset per environment, under its name; or one dataset.",
)
@SIMULTANEOUS_RUNS
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    show_default="the file's",
    help="Training steps of every run; schedules are scaled to them.",
)
@click.option("--seeds", metavar="LIST", show_default="the file's", help="Seeds, such as 0-4 or 0,3.")
@click.option(
    "--only", metavar="LABEL", multiple=True, help="Run only the method with this label; repeatable."
)
@click.option(
    "--environment", "environments", metavar="ENV", multiple=True, help="Run only on this one; repeatable."
)
@click.option(
    "--profile",
    type=click.Choice(PROFILES),
    show_default="the file's",
    help="Size of datasets, networks and training: `paper` is the paper's.",
)
@click.option("--build", is_flag=True, help="Build the datasets that do not exist.")
@click.option(
    "--tuned",
    type=click.Path(path_type=Path),
    metavar="TUNINGS",
    help="Take the best settings of the tunings in a folder, each in ENV-ALGO, or in a table of them.",
)
@click.option(
    "--reuse",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="RESULTS",
    help="Take over equal trainings of another results folder; repeatable.",
)
@DEVICE
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
    environments: tuple[str, ...],
    profile: Profile | None,
    build: bool,
    tuned: Path | None,
    reuse: tuple[Path, ...],
    device: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Run an experiment: every method on every environment with every seed.

    FILE is a TOML file; NAME is an experiment of --list. All inputs are checked before the first run
    starts; if datasets are missing, the commands that build them are printed, or --build runs them. With
    --profile, the steps that the file sets give way to the profile's. If the same command is run again, it
    keeps finished runs and continues interrupted runs from their last checkpoint; the results are those of
    uninterrupted runs. The workers share the cores. With --reuse, a method that another experiment trained
    with the same data, seed and settings is only evaluated, where that experiment did not.

    The results folder contains a JSON document per run in runs/, and table.csv. Returns are undiscounted.

    \b
    Examples:
      tcmrl experiment --list
      tcmrl experiment tour --workers 2
      tcmrl experiment window_length --seeds 0-2 --steps 1000 --out results/short
      tcmrl experiment figure4_half_cheetah_vel --profile paper --build --data data/paper
      tcmrl experiment table2 --tuned tuning --reuse results/figure4_point_robot
      tcmrl experiment mine.toml --data /disk/datasets --only TCMRL --only FOCAL
    """
    from tcmrl_algo import load_experiment, run_experiment
    from tcmrl_data import parse_indices

    if as_list:
        _print_list(as_json=as_json)
        return
    if name is None:
        raise click.UsageError("Name a FILE or an experiment of `tcmrl experiment --list`.")
    loaded = load_experiment(name)
    out = out or Path("results") / (loaded.name if profile is None else f"{loaded.name}-{profile}")
    loaded = loaded if profile is None else loaded.at_profile(profile)
    if build:
        _build(loaded, environments, data=data, workers=workers, quiet=quiet)
    settings = None
    if tuned is not None:
        from tcmrl_algo import tuned_settings

        settings = tuned_settings(loaded, tuned, environments=environments, only=only)
    with stopped_by_signals(lambda: same_command(out)):
        report = run_experiment(
            loaded,
            out,
            data=data,
            only=only,
            environments=environments,
            seeds=None if seeds is None else parse_indices(seeds, NUM_SEEDS, option="--seeds"),
            steps=steps,
            workers=workers,
            device=device,
            tuned=settings,
            reuse=reuse,
            report=lambda *ended: remark(_line(*ended), quiet=quiet),
        )
    if as_json:
        print_json(_document(report))
    else:
        for environment in dict.fromkeys(result.environment for result in report.results):
            for table in result_tables(environment, report.results):
                print_table(table)
        ran = len(report.results) - report.present
        click.echo(
            f"{report.out}: {ran} runs done, {report.present} already present, in {duration(report.seconds)}"
        )
        if report.results:
            remark(f"Next: tcmrl report {report.out}", quiet=quiet)
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; run the same command again to repeat the failed runs")


def _build(
    loaded: "Experiment", environments: tuple[str, ...], *, data: Path, workers: int | None, quiet: bool
) -> None:
    """Builds the datasets that the experiment lacks, one after another."""
    from tcmrl_algo import build_missing, missing_datasets

    for missing in missing_datasets(loaded, data):
        if not environments or missing.environment in environments:
            remark(f"building: {missing.command}", quiet=quiet)
            folder = missing.folder
            with stopped_by_signals(partial(same_command, folder)), StageProgress(quiet=quiet) as progress:
                build_missing(missing, workers=workers, report=partial(show_build, progress=progress))


def _print_list(*, as_json: bool) -> None:
    from tcmrl_algo import experiment_names, load_experiment

    found = [load_experiment(name) for name in experiment_names()]
    if as_json:
        fields = {"name", "title", "source", "environments", "methods", "seeds", "protocols", "claims"}
        print_json(
            {"experiments": [experiment.model_dump(mode="json", include=fields) for experiment in found]}
        )
        return
    table = make_table(
        "Experiments", columns=["experiment", "title", "runs"], text=["experiment"], long_text=["title"]
    )
    for experiment in found:
        num_runs = len(experiment.environments) * len(experiment.methods) * len(experiment.seeds)
        num_runs *= len(experiment.fold_numbers)
        table.add_row(experiment.name, experiment.title, str(num_runs))
    print_table(table)


def _line(result: "RunResult | str", done: int, total: int, seconds_left: float | None) -> str:
    left = f", about {duration(seconds_left)} left" if seconds_left else ""
    if isinstance(result, str):
        return f"{done} of {total}: failed: {result}{left}"
    finals = ", ".join(
        f"{protocol} {number(evaluation['mean_final'])}"
        for protocol, evaluation in result.evaluations.items()
    )
    return (
        f"{done} of {total}: {result.environment}, {result.method}, seed {result.seed}"
        f"{'' if result.fold is None else f', fold {result.fold}'}: {finals}{left}"
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
    """Returns of all methods across seeds, with their own contexts and those of other tasks; per protocol.

    Success rates have a column where the environment defines success.
    """
    from tcmrl_algo import by_method, summarize

    here = [result for result in results if result.environment == environment]
    with_success = any(row["success"] is not None for result in here for row in result.rows())
    success = ("success",) if with_success else ()
    columns = ("method", "runs", "mean", "95%", "other", "regret", *success)
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
            cells = [number(final.mean), interval, number(other), number(regret)]
            if with_success:
                rates = [row["success"] for row in chosen]
                cells.append(number(None if None in rates else summarize(rates).mean))
            table.add_row(method, str(len(chosen)), *cells)
        tables.append(table)
    return tables
