"""`tcmrl` and `tcmrl train`: meta-train on a dataset."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.recipe import Profile

from .evaluation import controls, evaluate
from .experiments import experiment, tune
from .frame import (
    duration,
    main_program,
    next_commands,
    number,
    output_options,
    print_json,
    remark,
    stopped_by_signals,
    typed_command,
)
from .groups import SETTINGS, Commands
from .options import (
    ALGORITHM_NAME,
    COUNT,
    DATASET,
    INDEX,
    PATH,
    TRAINING_PROFILE,
    TRAINING_SETTINGS,
    ManyNames,
)
from .progress import StageProgress
from .reports import report, runs

if TYPE_CHECKING:
    from tcmrl_algo import TrainingConfig, TrainingProgress, TrainingReport
    from tcmrl_data import Dataset


def main() -> None:
    """Entry point of the console script."""
    main_program(tcmrl)


@click.group(name="tcmrl", cls=Commands, context_settings=SETTINGS)
@click.version_option(package_name="tcmrl")
def tcmrl() -> None:
    """Meta-train on a dataset of `tcmrl-data build`, and adapt to its test tasks.

    \b
    Examples:
      tcmrl-data build point-robot --profile quick
      tcmrl train data/point-robot
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol all
      tcmrl tune data/point-robot --algo focal --trials 16
      tcmrl experiment perspectives --workers 2
      tcmrl report results/perspectives

    Exit codes: 0 success, 1 incomplete work, 2 bad usage or bad input.
    """


@click.command()
@DATASET
@click.option(
    "--algo",
    cls=ManyNames,
    type=ALGORITHM_NAME,
    metavar="NAME",
    show_default="the recipe's",
    help="Method to train.",
)
@TRAINING_PROFILE
@click.option(
    "--stop-at",
    type=COUNT,
    metavar="STEP",
    show_default="run.steps",
    help="Step to stop at; schedules and stages still have the length of run.steps.",
)
@click.option("--device", show_default="cpu", help="PyTorch device, such as cpu or cuda.")
@click.option(
    "--memory-limit",
    metavar="SIZE",
    show_default="half of the available memory",
    help="Size such as 2G; larger data are read through the cache.",
)
@click.option(
    "--watch",
    type=COUNT,
    metavar="STEPS",
    help="Every so many steps, also print and log the return of four training tasks after adaptation.",
)
@TRAINING_SETTINGS
@click.option("--resume", is_flag=True, help="Continue from the newest checkpoint in --out.")
@click.option("--seed", type=INDEX, show_default="0", help="Seed of all random numbers.")
@click.option(
    "--out", type=PATH, metavar="FOLDER", show_default="runs/ENV-ALGO-seedSEED", help="Folder of the run."
)
@output_options
def train(
    dataset: Path,
    algo: str | None,
    profile: Profile | None,
    stop_at: int | None,
    device: str | None,
    memory_limit: str | None,
    watch: int | None,
    overrides: tuple[str, ...],
    resume: bool,
    seed: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Meta-train on the training tasks of a dataset.

    DATASET is the dataset's folder, its manifest.json or a view. The training settings are those of the
    dataset's recipe; --set overrides single values. Ctrl-C, SIGTERM and SIGHUP save a checkpoint and end the
    run; SIGUSR1 saves one, and the run continues. --resume continues a run that was stopped or killed; the
    result is that of an uninterrupted run.

    --watch adapts a copy of the policy to stored trajectories of four of the training tasks. It says how
    training goes, not how well the policy generalizes, and changes no result. What it took is printed at the
    end.

    \b
    Examples:
      tcmrl train data/point-robot --seed 1
      tcmrl train data/point-robot --algo no_context --watch 500
      tcmrl train data/half-cheetah-vel --set batch.window_length=8
      tcmrl train data/point-robot --seed 1 --resume
    """
    from tcmrl_algo import TrainingWatch, resolve_for, resume_run, train_run
    from tcmrl_data import open_dataset, parse_bytes

    limit = parse_bytes(memory_limit) if memory_limit else None
    if resume and isinstance(dataset, Path) and not dataset.exists():  # else it is an address
        raise click.ClickException(f"{dataset} does not exist; name the present folder of the run's dataset")
    if isinstance(dataset, Path) and (dataset / "run.json").is_file():
        raise click.ClickException(
            f"{dataset} is a run, not a dataset; to continue it, run `tcmrl train DATASET --resume --out "
            f"{shlex.quote(str(dataset))}`"
        )
    opened = open_dataset(dataset)
    config = resolve_for(
        opened, profile=profile or opened.manifest.profile, algorithm=algo, overrides=overrides
    )
    folder = out or Path("runs") / f"{opened.name}-{config.settings.run.algorithm}-seed{seed or 0}"
    watching = TrainingWatch(opened, every=watch) if watch else None
    with stopped_by_signals(lambda: _how_to_continue(folder)), StageProgress() as progress:
        if watching is not None:
            progress.note(watching.described())
        shared: dict[str, Any] = {
            "steps": stop_at,
            "memory_limit": limit,
            "watch": watching,
            "report": lambda event: _show(progress, event),
            "say": progress.note,
        }
        if resume:
            _check_given(folder, algo=algo, profile=profile, seed=seed, overrides=overrides)
            report = resume_run(folder, opened, device=device, **shared)
        else:
            _note_source(opened, config, profile or opened.manifest.profile, progress)
            report = train_run(
                opened,
                folder,
                config=config,
                profile=profile or opened.manifest.profile,
                seed=seed or 0,
                device=device or "cpu",
                **shared,
            )
    _print_training(report, as_json=as_json)
    if watching is not None:
        remark(f"watching took {duration(watching.seconds)} of {duration(report.seconds)}")


def _note_source(
    dataset: "Dataset", config: "TrainingConfig", profile: Profile, progress: StageProgress
) -> None:
    """Says where the method's own settings come from, if it has any and the dataset does not hold them."""
    table = f"[training.{config.settings.run.algorithm}]"
    if config.method and config.training_source == "recipe":
        source = f"the installed recipe's, profile {profile!r}"
    elif config.method and config.training_source == "defaults":
        source = "the method's defaults"
    else:
        return
    progress.note(f"{dataset.path} holds no {table} table; its values are {source}")


def _check_given(
    folder: Path, *, algo: str | None, profile: Profile | None, seed: int | None, overrides: Sequence[str]
) -> None:
    """Refuses options that differ from what a run was begun with."""
    from tcmrl_algo import open_run

    record = open_run(folder).record
    for name, given, recorded in (
        ("--algo", algo, record.config.settings.run.algorithm),
        ("--profile", profile, record.profile),
        ("--seed", seed, record.seed),
    ):
        if given is not None and given != recorded:
            raise click.UsageError(f"{folder} is a run with {name} {recorded}, not {given}; omit {name}.")
    _check_settings(folder, record.config, overrides)


def _check_settings(folder: Path, config: "TrainingConfig", overrides: Sequence[str]) -> None:
    """Refuses `--set` options that differ from the settings of a run."""
    from tcmrl_algo import resolve

    tables = config.settings.model_dump() | {config.settings.run.algorithm: config.method}
    for text in overrides:
        found = resolve(tables, place=f"--set {text}", overrides=[text])
        if (found.settings, found.method) != (config.settings, config.method):
            raise click.UsageError(
                f"{folder} was not trained with --set {text}; omit it, or train a new run in another --out."
            )


def _how_to_continue(folder: Path) -> str:
    from tcmrl_algo import open_run

    if not (folder / "run.json").is_file():
        return f"no step was trained; to start, run `{typed_command()}` again"
    checkpoints = open_run(folder).checkpoints()
    step = checkpoints[-1].step if checkpoints else 0
    return f"to continue from step {step:,}, run `{typed_command('--resume')}`"


def _show(progress: StageProgress, event: "TrainingProgress") -> None:
    losses = [f"{name} {value:.3g}" for name, value in event.metrics.items() if name.startswith("loss/")]
    watched = [] if event.watched is None else [f"return {number(event.watched)}"]
    detail = ", ".join([*losses[:1], *watched, f"{event.data_share:.0%} waiting for data"])
    progress.update("training", done=event.step, total=event.steps, unit="steps", detail=detail)


def _print_training(report: "TrainingReport", *, as_json: bool) -> None:
    record = report.run.record
    algorithm = record.config.settings.run.algorithm
    if as_json:
        print_json(
            {
                "run": str(report.run.folder),
                "algorithm": algorithm,
                "environment": record.environment,
                "profile": record.profile,
                "seed": record.seed,
                "steps": report.step,
                "seconds": round(report.seconds, 3),
                "digest": report.digest,
            }
        )
        return
    click.echo(
        f"{report.run.folder}: {algorithm} on {record.environment}, seed {record.seed}, "
        f"{report.step:,} steps in {duration(report.seconds)}, tensors {report.digest[:12]}"
    )
    next_commands(["tcmrl", "evaluate", report.run.folder])


tcmrl.fill({"Train": [train, tune, experiment], "Look": [evaluate, controls, report, runs]})
