"""`tcmrl controls`: what adaptation is compared with on a dataset."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .evaluation import BEHAVIOR, FIXED
from .frame import make_table, number, output_options, print_json, print_table, remark
from .places import DATASET_PATH
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_algo import Controls

COLUMNS = ("uniform", "fixed_snapshot", "fixed_target", "behavior", "oracle")


@click.command()
@click.argument("dataset", metavar="DATASET", type=DATASET_PATH)
@output_options
def controls(dataset: Path, as_json: bool, quiet: bool) -> None:
    """Measure the controls of DATASET: policies that do not learn across tasks.

    They are measured once for a dataset and kept in the cache. Uniform actions. The best policy that acts the
    same in all tasks: the last behavior policy of a training task (fixed snapshot) or, where there is an
    oracle, the oracle for one target (fixed target), both fitted on the training tasks. The behavior policies
    of the test tasks themselves, without their noise. The oracle.

    \b
    Examples:
      tcmrl controls data/point-robot
      tcmrl controls data/half-cheetah-vel --json
    """
    from tcmrl_algo import dataset_controls
    from tcmrl_data import open_dataset

    with StageProgress(quiet=quiet) as progress:
        found = dataset_controls(
            open_dataset(dataset),
            report=lambda stage, done, total: progress.update(stage, done=done, total=total, unit="episodes"),
        )
    if as_json:
        print_json(found.model_dump(mode="json"))
        return
    table = make_table(
        f"{found.environment}: controls by test task",
        columns=("task", *(name.replace("_", " ") for name in COLUMNS)),
        long_text=("task",),
    )
    for task in found.tasks:
        table.add_row(str(task.task), *(number(getattr(task, name)) for name in COLUMNS))
    table.add_section()
    table.add_row("mean", *(number(found.mean(name)) for name in COLUMNS))
    print_table(table)
    remark("; ".join([*_fitted(found), FIXED, BEHAVIOR]), quiet=quiet)


def _fitted(found: "Controls") -> list[str]:
    """What the fixed policies are, and their means over the training tasks."""
    notes = []
    if found.fixed_snapshot is not None:
        policy = found.fixed_snapshot
        mean, average = number(policy.train_return), number(policy.average_return)
        notes.append(
            f"fixed snapshot: task {policy.task}, step {policy.step:,} ({mean} in training tasks; "
            f"{average} on average over the tasks' last policies)"
        )
    if found.fixed_target is not None:
        notes.append(f"fixed target: {number(found.fixed_target.train_return)} in training tasks")
    return notes
