"""`tcmrl experiment` and `tune`: many runs, and the search of settings."""

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.recipe import PROFILES, Profile

from .evaluation import split_words
from .frame import (
    duration,
    fail_incomplete,
    make_table,
    next_commands,
    number,
    output_options,
    print_json,
    print_rows,
    print_table,
    remark,
    same_command,
    stopped_by_signals,
)
from .making import show_build
from .options import (
    ALGORITHM_NAME,
    COUNT,
    DATASET,
    DEVICE,
    INDEX,
    PATH,
    PROTOCOL_NAME,
    TRAINING_PROFILE,
    TRAINING_SETTINGS,
    WORKERS,
    ManyNames,
    names_or_files,
)
from .progress import StageProgress

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Experiment, ExperimentReport, RunResult, Trial, Tuning, TuningReport

NUM_SEEDS = 10_000


def _shipped_names() -> list[str]:
    from tcmrl_algo import experiment_names

    return experiment_names()


@click.command()
@click.argument("name", metavar="FILE|NAME", required=False, shell_complete=names_or_files(_shipped_names))
@click.option("--list", "as_list", is_flag=True, help="List the experiments of this package.")
@click.option(
    "--out", type=PATH, metavar="FOLDER", show_default="results/NAME", help="Folder of the results."
)
@click.option(
    "--data",
    type=PATH,
    show_default="the file's, else data",
    metavar="FOLDER",
    help="Folder that contains a dataset per environment, under its name; or one dataset.",
)
@WORKERS
@click.option(
    "--steps",
    type=COUNT,
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
    type=PATH,
    metavar="TUNINGS",
    help="Take the best settings of the tunings in a folder, each in ENV-ALGO, or in a table of them.",
)
@DEVICE
@output_options
def experiment(
    name: str | None,
    as_list: bool,
    out: Path | None,
    data: Path | None,
    workers: int | None,
    steps: int | None,
    seeds: str | None,
    only: tuple[str, ...],
    environments: tuple[str, ...],
    profile: Profile | None,
    build: bool,
    tuned: Path | None,
    device: str,
    as_json: bool,
) -> None:
    """Run an experiment: every method on every environment with every seed.

    FILE is a TOML file; NAME is an experiment of --list. All inputs are checked before the first run
    starts; if datasets are missing, the commands that build them are printed, or --build runs them. With
    --profile, the steps that the file sets give way to the profile's. If the same command is run again, it
    keeps finished runs and continues interrupted runs from their last checkpoint; the results are those of
    uninterrupted runs. The workers share the cores.

    The results folder contains a JSON document per run in runs/, and table.csv. Returns are undiscounted.

    \b
    Examples:
      tcmrl experiment --list
      tcmrl experiment tour --workers 2
      tcmrl experiment negative_rewards --profile paper --build
      tcmrl experiment table2 --tuned tuning
      tcmrl experiment mine.toml --data /disk/datasets --only TCMRL
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
        _build(loaded, environments, data=data, workers=workers)
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
            report=lambda *ended: remark(_run_line(*ended)),
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
            next_commands(["tcmrl", "report", report.out])
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; run the same command again to repeat the failed runs")


def _build(
    loaded: "Experiment", environments: tuple[str, ...], *, data: Path | None, workers: int | None
) -> None:
    """Builds the datasets that the experiment lacks, one after another."""
    from tcmrl_algo import build_missing, missing_datasets

    for missing in missing_datasets(loaded, data):
        if not environments or missing.environment in environments:
            remark(f"building: {missing.command}")
            folder = missing.folder
            with stopped_by_signals(partial(same_command, folder)), StageProgress() as progress:
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
    rows = []
    for one in found:
        num_runs = len(one.environments) * len(one.methods) * len(one.seeds) * len(one.fold_numbers)
        rows.append((one.name, one.title, str(num_runs)))
    print_rows("Experiments", ["experiment", "title", "runs"], rows, text=["experiment"], long_text=["title"])


def _run_line(result: "RunResult | str", done: int, total: int, seconds_left: float | None) -> str:
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
        tasks = split_words(here[0].evaluations[protocol]["tasks"][0]["split"])
        title = f"{environment}, protocol {protocol}: returns on the {tasks}s"
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


@click.command()
@DATASET
@click.option(
    "--algo", cls=ManyNames, type=ALGORITHM_NAME, metavar="NAME", required=True, help="Method to tune."
)
@click.option(
    "--trials",
    type=COUNT,
    required=True,
    help="Number of trials; the first one takes the settings as they are.",
)
@click.option(
    "--out", type=PATH, metavar="FOLDER", show_default="tuning/ENV-ALGO", help="Folder of the trials."
)
@TRAINING_PROFILE
@click.option(
    "--steps",
    type=COUNT,
    show_default="run.steps",
    help="Training steps of every trial; schedules are scaled to them.",
)
@click.option("--seeds", metavar="LIST", default="0", show_default=True, help="Seeds of every trial.")
@click.option("--seed", type=INDEX, default=0, show_default=True, help="Seed of the proposals.")
@click.option(
    "--held-out",
    metavar="LIST",
    show_default="a fifth of them, evenly spaced",
    help="Training tasks that trials are scored on, such as 3,17.",
)
@click.option(
    "--protocol",
    "protocols",
    type=PROTOCOL_NAME,
    multiple=True,
    show_default="paper, offline, idaq",
    help="Adaptation protocol of the score, which is their mean; repeatable.",
)
@TRAINING_SETTINGS
@WORKERS
@DEVICE
@output_options
def tune(
    dataset: Path,
    algo: str,
    trials: int,
    out: Path | None,
    profile: Profile | None,
    steps: int | None,
    seeds: str,
    seed: int,
    held_out: str | None,
    protocols: tuple[str, ...],
    overrides: tuple[str, ...],
    workers: int | None,
    device: str,
    as_json: bool,
) -> None:
    """Search the settings of a method; test tasks are never used.

    Every trial trains on the training tasks without some held-out ones, on which it is scored: 0 is the
    return of uniform actions, 1 that of the reference, the mean is over held-out tasks, protocols and seeds.
    The method's file declares what is searched; what --set sets is not. Compare methods after equal numbers
    of trials.

    If the same command is run again, it keeps finished trials and continues interrupted runs; with a larger
    --trials it adds trials. The result is tuning.json in the folder. Needs Optuna: pip install 'tcmrl[tune]'.

    \b
    Examples:
      tcmrl tune data/point-robot --algo tcmrl --trials 16 --steps 3000
      tcmrl tune data/point-robot --algo focal --trials 16 --seeds 0,1
      tcmrl tune data/point-robot --algo csro --trials 8 --steps 3000
    """
    from tcmrl_algo import tune_method
    from tcmrl_algo.experiment.spec import PAPER_PROTOCOLS
    from tcmrl_data import MAX_TASKS, open_dataset, parse_indices

    opened = open_dataset(dataset)
    folder = out or Path("tuning") / f"{opened.name}-{algo}"
    with stopped_by_signals(lambda: same_command(folder)):
        report = tune_method(
            opened,
            folder,
            algorithm=algo,
            trials=trials,
            profile=profile,
            steps=steps,
            seeds=parse_indices(seeds, NUM_SEEDS, option="--seeds"),
            seed=seed,
            held_out=None if held_out is None else parse_indices(held_out, MAX_TASKS, option="--held-out"),
            protocols=protocols or PAPER_PROTOCOLS,
            overrides=overrides,
            workers=workers,
            device=device,
            report=lambda *ended: remark(_trial_line(*ended)),
        )
    if as_json:
        print_json(report.tuning.model_dump(mode="json") | {"failed": list(report.failed)})
    else:
        print_table(_trial_table(report.tuning))
        _print_end(report, dataset, overrides)
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; run the same command again to repeat the failed runs")


def _trial_line(trial: "Trial", done: int, total: int, best: float | None, seconds_left: float) -> str:
    left = f", about {duration(seconds_left)} left" if seconds_left else ""
    return f"{done} of {total}: trial {trial.number}: {_score(trial)}; best {_decimals(best)}{left}"


def _score(trial: "Trial") -> str:
    return _decimals(trial.score) if trial.error is None else f"diverged: {trial.error}"


def _decimals(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _trial_table(tuning: "Tuning") -> "Table":
    """All ended trials, the best one first."""
    title = (
        f"{tuning.environment}, {tuning.algorithm}: normalised returns on {len(tuning.held_out)} held-out "
        f"training tasks after {tuning.steps:,} steps"
    )
    columns = ("trial", "score", *tuning.protocols, "settings")
    table = make_table(title, columns=columns, long_text=["settings"])
    ended = [trial for trial in tuning.trials if trial.is_done]
    for trial in sorted(ended, key=lambda trial: (trial.score is None, -(trial.score or 0.0))):
        means = [
            _decimals(sum(run.normalized[protocol] for run in trial.runs) / len(trial.runs))
            if trial.runs
            else "–"
            for protocol in tuning.protocols
        ]
        settings = "as they are" if trial.number == 0 else " ".join(trial.overrides)
        table.add_row(str(trial.number), _decimals(trial.score), *means, settings)
    return table


def _print_end(report: "TuningReport", dataset: Path, overrides: tuple[str, ...]) -> None:
    tuning, best = report.tuning, report.tuning.best_trial
    ended = sum(trial.is_done for trial in tuning.trials)
    click.echo(
        f"{report.out}: {ended - report.present} trials done, {report.present} already present, "
        f"in {duration(report.seconds)}"
    )
    if best is None:
        return
    settings: list[Any] = [part for text in (*overrides, *best.overrides) for part in ("--set", text)]
    command = ["tcmrl", "train", str(dataset), "--algo", tuning.algorithm, "--profile", tuning.profile]
    remark("Next, with the best settings:")
    click.echo(shlex.join([*command, *settings]))
