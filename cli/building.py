"""`tcmrl-data plan` and `build`: estimate and build the dataset of a recipe."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tcmrl_data.foundation.machine import size
from tcmrl_data.recipe import PROFILES, Profile

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
from .options import PROCESSES
from .places import complete_environments, complete_recipe_keys
from .plugins import BEHAVIOR, ENGINE
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import BuildEvent, Recipe

Command = TypeVar("Command", bound=Callable[..., Any])


recipe_argument = click.argument("name_or_file", metavar="ENV|FILE", shell_complete=complete_environments)
profile_option = click.option(
    "--profile",
    type=click.Choice(PROFILES),
    default="paper",
    show_default=True,
    help="The full recipe (paper) or a smaller version of it.",
)
set_option = click.option(
    "--set",
    "overrides",
    shell_complete=complete_recipe_keys,
    metavar="SECTION.KEY=VALUE",
    multiple=True,
    help="Override a value of the recipe; repeatable.",
)


def recipe_options(command: Command) -> Command:
    """Adds the argument ENV|FILE and the options that `plan` and `build` share."""
    decorators = (
        recipe_argument,
        profile_option,
        click.option(
            "--behavior",
            type=BEHAVIOR,
            show_default="the recipe's",
            help="Source of the behavior policies.",
        ),
        click.option(
            "--tasks",
            metavar="LIST",
            show_default="the profile's",
            help="Indices of tasks, such as 0-9,12.",
        ),
        set_option,
        PROCESSES,
        click.option(
            "--engine",
            default="local",
            show_default=True,
            type=ENGINE,
            help="Engine that runs the work.",
        ),
        output_options,
    )
    for decorator in reversed(decorators):
        command = decorator(command)
    return command


@click.command()
@recipe_options
def plan(
    name_or_file: str,
    profile: Profile,
    behavior: str | None,
    tasks: str | None,
    overrides: tuple[str, ...],
    workers: int | None,
    engine: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Estimate the size, memory and time of a build.

    ENV is an environment with a recipe, and FILE is a recipe of your own, which ends in .toml. The time is
    extrapolated from a measurement of a few seconds on this machine.

    \b
    Examples:
      tcmrl-data plan half-cheetah-vel
      tcmrl-data plan ml1/reach --behavior scripted --tasks 0-9 --workers 8
      tcmrl-data plan my-recipe.toml
    """
    import tcmrl_data

    recipe = tcmrl_data.load_recipe(name_or_file, profile=profile, overrides=overrides, behavior=behavior)
    chosen = _parse_tasks(recipe, tasks)
    remark("measuring this machine for a few seconds …", quiet=quiet or as_json)
    planned = tcmrl_data.forecast_build(tcmrl_data.plan_build(recipe, tasks=chosen), workers=workers)
    if as_json:
        print_json(dataclasses.asdict(planned))
        return
    title = f"Plan: {planned.environment}, profile {planned.profile}"
    table = make_table(title, columns=["property", "value"], text=["property"], long_text=["value"])
    rows = {
        "behavior": planned.behavior,
        "tasks": f"{planned.tasks:,} ({planned.train:,} train, {planned.test:,} test)",
        "snapshots per task": f"{planned.snapshots:,}",
        "parts": f"{planned.parts:,} with {planned.episodes:,} episodes",
        "environment steps of training": f"{planned.training_steps:,}",
        "stored environment steps": f"{planned.rollout_steps:,} at most",
        "size": f"{size(planned.bytes)} at most",
        "memory": f"{size(planned.unit_bytes)} per worker at most",
        "time": f"about {duration(planned.seconds)} ({duration(planned.seconds_low)} to "
        f"{duration(planned.seconds_high)}) with {planned.workers} workers",
    }
    for name, value in rows.items():
        table.add_row(name, value)
    print_table(table)


@click.command()
@recipe_options
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    show_default="data/ENV",
    help="Folder of the dataset.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0, max=2**63 - 1),
    default=0,
    show_default=True,
    help="Seed of behavior training and rollouts; tasks and split do not depend on it.",
)
@click.option(
    "--drop-tasks",
    metavar="LIST",
    help="Indices of tasks that the dataset is to do without, such as one whose training diverges.",
)
@click.option(
    "--ray-address",
    metavar="ADDRESS",
    show_default="a new local cluster",
    help="Address of a running Ray cluster that can access the dataset's folder.",
)
@click.option(
    "--checkpoint-every",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    default=60.0,
    show_default=True,
    help="Least time between two checkpoints of behavior training; 0 for as many as possible.",
)
def build(
    name_or_file: str,
    profile: Profile,
    behavior: str | None,
    tasks: str | None,
    overrides: tuple[str, ...],
    workers: int | None,
    engine: str,
    as_json: bool,
    quiet: bool,
    out: Path | None,
    seed: int,
    drop_tasks: str | None,
    ray_address: str | None,
    checkpoint_every: float,
) -> None:
    """Build a dataset, or the missing parts of one.

    ENV is an environment with a recipe, and FILE is a recipe of your own. FILE ends in .toml and names its
    environment in the table [environment].

    A complete dataset is not changed. If a build was stopped, the same command continues it: Ctrl-C and
    SIGTERM leave a checkpoint of every training, and a kill the one before. With other
    indices in --tasks, the command adds tasks to the dataset. The parts of tasks in --drop-tasks stay on disk
    but no longer belong to the dataset, until a build names the tasks in --tasks.

    \b
    Examples:
      tcmrl-data build point-robot --profile quick
      tcmrl-data build half-cheetah-vel --tasks 0-9 --workers 4 --out data/cheetah
      tcmrl-data build ml1/reach --behavior scripted --set rollouts.episodes=20
      tcmrl-data build point-robot --drop-tasks 6
      tcmrl-data build my-recipe.toml --profile quick
    """
    import tcmrl_data

    recipe = tcmrl_data.load_recipe(name_or_file, profile=profile, overrides=overrides, behavior=behavior)
    chosen = _parse_tasks(recipe, tasks)
    out = out or Path("data") / recipe.environment.name
    with stopped_by_signals(lambda: same_command(out)), StageProgress(quiet=quiet) as progress:
        report = tcmrl_data.build_dataset(
            recipe,
            out,
            seed=seed,
            tasks=chosen,
            dropped=_parse_tasks(recipe, drop_tasks, option="--drop-tasks") or (),
            workers=workers,
            engine=engine,
            address=ray_address,
            checkpoint_seconds=checkpoint_every,
            progress=lambda event: show_build(event, progress),
        )
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        click.echo(
            f"{report.dataset}: {report.built:,} parts built, {report.present:,} already present, "
            f"in {duration(report.seconds)}; root {report.root[:12]}"
            f"{'; the folder cannot be written, and no write was needed' if report.read_only else ''}"
        )
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; run the same command again to build the missing parts")


def _parse_tasks(recipe: "Recipe", text: str | None, *, option: str = "--tasks") -> list[int] | None:
    import tcmrl_data

    return None if text is None else tcmrl_data.parse_indices(text, recipe.environment.tasks, option=option)


def show_build(event: "BuildEvent", progress: StageProgress) -> None:
    """Shows how far a build is."""
    if event.kind in ("unit_failed", "warning"):
        progress.note(event.message)
    progress.update("behavior training", done=event.steps_done, total=event.steps_total, unit="steps")
    progress.update("published parts", done=event.parts_done, total=event.parts_total, unit="parts")
