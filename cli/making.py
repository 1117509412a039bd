"""`tcmrl-data build` and `import`."""

import dataclasses
import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import available_cores, size
from tcmrl_data.foundation.plugins import declared_names
from tcmrl_data.recipe import PROFILES, Profile

from .frame import (
    FOLDED_WIDTH,
    duration,
    fail_incomplete,
    is_quiet,
    make_table,
    output_options,
    print_json,
    print_properties,
    print_table,
    remark,
    same_command,
    stopped_by_signals,
)
from .options import (
    BEHAVIOR_NAME,
    DRY_RUN,
    ENGINE_NAME,
    INDEX,
    LABEL,
    NEW_DATASET,
    PATH,
    READER_NAME,
    WORKERS,
    allow_only,
    names_or_files,
)
from .progress import StageProgress, with_progress

if TYPE_CHECKING:
    from tcmrl_data import BuildEvent, BuildPlan, Dataset, Recipe


BUSY_SHARE = 0.25
"""Other work that keeps a larger share of the cores busy makes a build slower than on an idle machine."""


@click.command()
@click.argument(
    "name_or_file",
    metavar="ENV|FILE",
    shell_complete=names_or_files(lambda: declared_names("tcmrl.environments")),
)
@click.option(
    "--profile",
    type=click.Choice(PROFILES),
    default="paper",
    show_default=True,
    help="The full recipe (paper) or a smaller version of it.",
)
@click.option("--plan", is_flag=True, help="Only measure and print size, memory and time.")
@click.option("--recipe", "as_recipe", is_flag=True, help="Only print the values that --set takes.")
@click.option(
    "--set",
    "overrides",
    metavar="SECTION.KEY=VALUE",
    multiple=True,
    help="Override a value of the recipe; repeatable.",
)
@click.option(
    "--behavior", type=BEHAVIOR_NAME, show_default="the recipe's", help="Source of the behavior policies."
)
@click.option("--tasks", metavar="LIST", show_default="the profile's", help="Only these tasks: 0-9,12.")
@click.option(
    "--drop-tasks", metavar="LIST", help="Tasks to do without, such as one whose training diverges."
)
@click.option("--out", type=PATH, metavar="FOLDER", show_default="data/ENV", help="Folder of the dataset.")
@click.option(
    "--seed",
    type=click.IntRange(min=0, max=2**63 - 1),
    default=0,
    show_default=True,
    help="Seed of behavior training and rollouts; tasks and split do not depend on it.",
)
@WORKERS
@click.option(
    "--engine", default="local", show_default=True, type=ENGINE_NAME, help="Engine that runs the work."
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
@click.option(
    "--expect-root",
    metavar="ROOT|DATASET",
    help="Root of a published dataset, or its folder or address: say whether the build is equal to it.",
)
@click.option(
    "--check-published",
    is_flag=True,
    help="Say whether the build has the root that came with this package.",
)
@output_options
@click.pass_context
def build(
    context: click.Context,
    name_or_file: str,
    profile: Profile,
    plan: bool,
    as_recipe: bool,
    overrides: tuple[str, ...],
    behavior: str | None,
    tasks: str | None,
    drop_tasks: str | None,
    out: Path | None,
    seed: int,
    workers: int | None,
    engine: str,
    ray_address: str | None,
    checkpoint_every: float,
    expect_root: str | None,
    check_published: bool,
    as_json: bool,
) -> None:
    """Build a dataset, or the missing parts of one.

    ENV is an environment with a recipe, and FILE is a recipe of your own. FILE ends in .toml and names its
    environment in the table [environment]. --recipe prints the values of a recipe and where they come from.
    --plan measures this machine for a few seconds and prints what a build takes.

    A complete dataset is not changed. If a build was stopped, the same command continues it: Ctrl-C and
    SIGTERM leave a checkpoint of every training, and a kill the one before. With other indices in --tasks,
    the command adds tasks to the dataset. The parts of tasks in --drop-tasks stay on disk but no longer
    belong to the dataset, until a build names the tasks in --tasks.

    With --expect-root the exit code is 1 if the root is not the published one. Of a published dataset the
    first part that differs is named, and why: builds on other processors or packages may differ.
    --check-published does so for the roots of own recipes that come with this package.

    \b
    Examples:
      tcmrl-data build point-robot --profile quick
      tcmrl-data build half-cheetah-vel --plan --workers 8
      tcmrl-data build point-robot --recipe
      tcmrl-data build ml1/reach --set rollouts.episodes=20
      tcmrl-data build point-robot --drop-tasks 6
      tcmrl-data build point-robot --expect-root s3://bucket/point-robot
    """
    import tcmrl_data
    from tcmrl_data.dataset.diff import why_not_published
    from tcmrl_data.dataset.roots import published_roots, why_not_as_published

    if as_recipe:
        allow_only(context, "--recipe", "profile", "overrides")
        _print_recipe(name_or_file, profile=profile, overrides=overrides, as_json=as_json)
        return

    def load(name: Profile) -> "Recipe":
        return tcmrl_data.load_recipe(name_or_file, profile=name, overrides=overrides, behavior=behavior)

    recipe = load(profile)
    limit = recipe.environment.tasks
    chosen = None if tasks is None else tcmrl_data.parse_indices(tasks, limit)
    if plan:
        allow_only(context, "--plan", "profile", "overrides", "behavior", "tasks", "workers")
        _print_plan(tcmrl_data.plan_build(recipe, tasks=chosen), workers=workers, as_json=as_json)
        return
    expected = None if expect_root is None else _published(expect_root)
    roots = published_roots(recipe, seed) if check_published else None
    dropped = drop_tasks and tcmrl_data.parse_indices(drop_tasks, limit, option="--drop-tasks")
    out = out or Path("data") / recipe.environment.name
    is_new = not as_json and not (out / "manifest.json").exists()

    def follow(event: "BuildEvent") -> None:
        if event.kind == "start" and is_new and not is_quiet():
            for line in _costs(load, profile, chosen):
                progress.note(line)
        show_build(event, progress)

    with stopped_by_signals(lambda: same_command(out)), StageProgress() as progress:
        report = tcmrl_data.build_dataset(
            recipe,
            out,
            seed=seed,
            tasks=chosen,
            dropped=dropped or (),
            workers=workers,
            engine=engine,
            address=ray_address,
            checkpoint_seconds=checkpoint_every,
            progress=follow,
        )
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        click.echo(
            f"{report.dataset}: {report.built:,} parts built, {report.present:,} already present, "
            f"in {duration(report.seconds)}"
            f"{f'; root {report.root[:12]}' if report.built + report.present else ''}"
            f"{'; the folder cannot be written, and no write was needed' if report.read_only else ''}"
        )
    if report.failed:
        more = "" if len(report.failed) == 1 else f" (and {len(report.failed) - 1} more)"
        fail_incomplete(f"{report.failed[0]}{more}; run the same command again to build the missing parts")
        return
    problems = []
    if expected is not None:
        problems.append(why_not_published(out, expected))
    if roots is not None:
        problems.append(why_not_as_published(tcmrl_data.open_dataset(out), roots))
    for problem in problems:
        if problem is not None:
            fail_incomplete(problem)
    if problems:
        remark("root as published")


def _published(text: str) -> "str | Dataset":
    """The root that is expected, or the dataset that has it, which is opened before anything is built."""
    import tcmrl_data

    return text if re.fullmatch("[0-9a-f]{12,64}", text) else tcmrl_data.open_dataset(text)


def show_build(event: "BuildEvent", progress: StageProgress) -> None:
    """Shows how far a build is."""
    if event.kind in ("unit_failed", "warning"):
        progress.note(event.message)
    progress.update("behavior training", done=event.steps_done, total=event.steps_total, unit="steps")
    progress.update("published parts", done=event.parts_done, total=event.parts_total, unit="parts")


def _costs(load: Any, chosen_profile: Profile, tasks: Sequence[int] | None) -> Iterator[str]:
    """What the chosen profile takes, and what the others would."""
    from tcmrl_data import plan_build

    for profile in sorted(PROFILES, key=lambda name: name != chosen_profile):
        try:
            plan = plan_build(load(profile), tasks=tasks)
        except TcmrlError:
            continue  # the recipe has no such profile, or --set does not fit it
        word = "this build" if profile == chosen_profile else f"--profile {profile}"
        yield f"{word}: {_cost(plan)}"


def _cost(plan: "BuildPlan") -> str:
    number, parts = len(plan.tasks), len(plan.tasks) * len(plan.source.steps)
    return (
        f"{number:,} task{'' if number == 1 else 's'}, {number * plan.source.training_steps:,} steps of "
        f"training, {parts:,} parts, {size(parts * plan.part_bytes)} at most"
    )


def _print_plan(plan: "BuildPlan", *, workers: int | None, as_json: bool) -> None:
    import tcmrl_data

    if not as_json:
        remark("measuring this machine for a few seconds …")
    busy, cores = os.getloadavg()[0], available_cores()
    planned = tcmrl_data.forecast_build(plan, workers=workers)
    if as_json:
        print_json(dataclasses.asdict(planned))
        return
    title = f"Plan: {planned.environment}, profile {planned.profile}"
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
    print_properties(title, rows)
    if busy > BUSY_SHARE * cores:
        remark(f"This machine is busy: {busy:.1f} processes on {cores} cores; the time is that beside them.")


def _print_recipe(name_or_file: str, *, profile: Profile, overrides: tuple[str, ...], as_json: bool) -> None:
    import tcmrl_data

    found = tcmrl_data.recipe_values(name_or_file, profile=profile, overrides=overrides)
    if as_json:
        print_json(dataclasses.asdict(found))
        return
    title = f"Recipe of {found.environment}, profile {found.profile}"
    table = make_table(title, columns=["key", "value", "source"], text=["key"], long_text=["value", "source"])
    texts = [_value_text(value.value) for value in found.values]
    numbers = [word for text in texts for word in text.split() if not word[0].isalpha()]
    table.columns[1].min_width = max(FOLDED_WIDTH, *map(len, numbers))  # so that no number is folded
    for value, text in zip(found.values, texts, strict=True):
        table.add_row(value.key, text, printable(value.source))
    print_table(table)


def _value_text(value: Any) -> str:
    """A value as `--set` takes it; a dash where it is not set."""
    if value is None:
        return "–"
    return printable(value) if isinstance(value, str) else json.dumps(value, default=str)


@click.command(name="import")
@click.argument("format_name", metavar="FORMAT", type=READER_NAME)
@click.argument("files", metavar="FILE…", nargs=-1, required=True, type=PATH)
@NEW_DATASET
@click.option(
    "--environment",
    metavar="ENV",
    show_default="foreign",
    help="Environment that the episodes come from; its sizes and horizon are compared.",
)
@click.option(
    "--first-task",
    type=INDEX,
    metavar="N",
    show_default="the files' own, or 0",
    help="Task of the first FILE; further ones count on.",
)
@click.option(
    "--task-file",
    type=PATH,
    metavar="FILE",
    help='JSON list of {"index", "split", "parameters"}: what the files do not say of tasks.',
)
@click.option("--option", "options", multiple=True, metavar="NAME=VALUE", help="Option of the format.")
@LABEL
@click.option("--licence", help="SPDX licence of the data, recorded as their origin.")
@click.option("--url", help="Where the data come from, recorded as their origin.")
@DRY_RUN
@output_options
def import_data(
    format_name: str,
    files: tuple[Path, ...],
    out: Path,
    environment: str | None,
    first_task: int | None,
    task_file: Path | None,
    options: tuple[str, ...],
    label: str | None,
    licence: str | None,
    url: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make a dataset from files of another program.

    Files are read without running code of them, and without reading other files. What they do not say stays
    open: seeds, policies and reference returns. A stopped import goes on when the command is run again.

    \b
    Examples:
      tcmrl-data import hdf5 hopper_medium.hdf5 --out data/hopper
      tcmrl-data import hdf5 a.hdf5 --option observation_keys=a,b --out b
      tcmrl-data import minari ~/.minari/datasets/D4RL/door/human-v2 --out a
      tcmrl-data import idaq-npy cheetah --environment half-cheetah-vel --out a
    """
    import tcmrl_data

    report = with_progress(
        lambda progress: tcmrl_data.import_dataset(
            format_name,
            files,
            out,
            environment=environment,
            task=first_task,
            tasks=task_file,
            options=dict(map(_option, options)),
            label=label,
            licence=licence,
            url=url,
            dry_run=dry_run,
            progress=progress,
        ),
        stage="import",
        out=out,
    )
    if as_json:
        print_json(dataclasses.asdict(report) | {"out": out})
        return
    for note in report.notes:
        remark(note)
    counts = f"{report.tasks:,} tasks, {report.parts:,} parts, {report.episodes:,} episodes"
    sizes = f"observations {report.observation_dim}, actions {report.action_dim}, horizon {report.horizon}"
    end = "nothing written" if report.root is None else f"root {report.root[:12]}"
    click.echo(f"{out}: {report.environment}, {counts} with {report.steps:,} steps, {sizes}; {end}")


def _option(text: str) -> tuple[str, Any]:
    """A name and its value: an integer where it looks like one, else text."""
    name, equals, value = text.partition("=")
    if not equals:
        raise click.UsageError(f"--option {text!r}: expected NAME=VALUE")
    return name, int(value) if value.isdecimal() else value
