"""`tcmrl tune`: search the settings of a method on held-out training tasks."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.recipe import Profile

from .experiments import NUM_SEEDS
from .frame import (
    duration,
    fail_incomplete,
    make_table,
    output_options,
    print_json,
    print_table,
    remark,
    same_command,
    stopped_by_signals,
)
from .options import DEVICE, SIMULTANEOUS_RUNS, TRAINING_PROFILE, TRAINING_SETTINGS
from .places import DATASET_PATH
from .plugins import ALGORITHM, PROTOCOL_NAME

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Trial, Tuning, TuningReport


@click.command()
@click.argument("manifest", metavar="MANIFEST", type=DATASET_PATH)
@click.option("--algo", type=ALGORITHM, required=True, help="Method to tune.")
@click.option(
    "--trials",
    type=click.IntRange(min=1),
    required=True,
    help="Number of trials; the first one takes the settings as they are.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    show_default="tuning/ENV-ALGO",
    help="Folder of the trials.",
)
@TRAINING_PROFILE
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    show_default="run.steps",
    help="Training steps of every trial; schedules are scaled to them.",
)
@click.option("--seeds", metavar="LIST", default="0", show_default=True, help="Seeds of every trial.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the proposals."
)
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
@SIMULTANEOUS_RUNS
@DEVICE
@output_options
def tune(
    manifest: Path,
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
    quiet: bool,
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
      tcmrl tune data/point-robot --algo focal --trials 16 --steps 3000 --seeds 0,1
      tcmrl tune data/point-robot --algo csro --trials 8 --set optimizer.learning_rate=0.001
    """
    from tcmrl_algo import tune_method
    from tcmrl_algo.experiment.spec import PAPER_PROTOCOLS
    from tcmrl_data import MAX_TASKS, open_dataset, parse_indices

    dataset = open_dataset(manifest)
    folder = out or Path("tuning") / f"{dataset.name}-{algo}"
    with stopped_by_signals(lambda: same_command(folder)):
        report = tune_method(
            dataset,
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
            report=lambda *ended: remark(_line(*ended), quiet=quiet),
        )
    if as_json:
        print_json(report.tuning.model_dump(mode="json") | {"failed": list(report.failed)})
    else:
        print_table(_trial_table(report.tuning))
        _print_end(report, manifest, overrides, quiet=quiet)
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; run the same command again to repeat the failed runs")


def _line(trial: "Trial", done: int, total: int, best: float | None, seconds_left: float) -> str:
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


def _print_end(report: "TuningReport", manifest: Path, overrides: tuple[str, ...], *, quiet: bool) -> None:
    tuning, best = report.tuning, report.tuning.best_trial
    ended = sum(trial.is_done for trial in tuning.trials)
    click.echo(
        f"{report.out}: {ended - report.present} trials done, {report.present} already present, "
        f"in {duration(report.seconds)}"
    )
    if best is None:
        return
    settings: list[Any] = [part for text in (*overrides, *best.overrides) for part in ("--set", text)]
    command = ["tcmrl", "train", str(manifest), "--algo", tuning.algorithm, "--profile", tuning.profile]
    remark("Next, with the best settings:", quiet=quiet)
    click.echo(shlex.join([*command, *settings]))
