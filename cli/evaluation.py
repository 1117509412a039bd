"""`tcmrl evaluate` and `controls`: returns after adaptation, and what they are compared with."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .frame import footnotes, make_table, number, output_options, print_json, print_table, remark
from .options import ALL_PROTOCOLS, COUNT, DATASET, FILE, INDEX, PATH, PROTOCOL_OR_ALL
from .progress import StageProgress

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Controls, Evaluation, TaskResult

OTHER = "other: the same policy with the contexts of other tasks"
PRIVILEGED = "privileged: a control that observes the task parameters"
SCORES = {
    "regret": "regret: oracle - adapted",
    "normalized": "normalized: 0 is uniform actions, 1 the best behavior policy without its noise",
}
FIXED = "fixed: the best policy that acts the same in all tasks, fitted on the training tasks"
BEHAVIOR = "behavior: the best behavior policy of the task itself, without its noise"


def score_tables(results: Sequence["Evaluation"]) -> list["Table"]:
    """Tables of returns: controls, means by protocol if there are several, and tasks by protocol."""
    first = results[0]
    tasks = split_words(first.tasks[0].split)
    mark = " (privileged)" if first.privileged else ""
    run = f"{first.algorithm}{mark} on {first.environment}, seed {first.seed}"
    score, with_success = _score(results), _with_success(results)

    def table(title: str, row_name: str) -> "Table":
        success = ("success",) if with_success else ()
        columns = (row_name, "uniform", "oracle", "adapted", "other", score, *success)
        return make_table(title, columns=columns, long_text=(row_name,))

    blocks = []
    means = table(f"{run}: means over {len(first.tasks)} {tasks}s", "protocol")
    for result in results:
        name = f"protocol {result.protocol}" if len(results) > 1 else f"{run}, {result.protocol}"
        block = table(f"{name}: returns by {tasks}", "task")
        rows = [_values(task, score, with_success=with_success) for task in result.tasks]
        mean = [number(_mean(column)) for column in zip(*rows, strict=True)]
        for task, values in zip(result.tasks, rows, strict=True):
            block.add_row(str(task.task), *map(number, values))
        block.add_section()
        block.add_row("mean", *mean)
        blocks.append(block)
        means.add_row(result.protocol, *mean)
    return [_controls_table(first), *([means] if len(results) > 1 else []), *blocks]


def _controls_table(result: "Evaluation") -> "Table":
    """Mean returns of the controls of the dataset, which are those of every protocol."""
    tasks = f"{len(result.tasks)} {split_words(result.tasks[0].split)}s"
    table = make_table(
        f"{result.environment}: controls, means over {tasks}",
        columns=("uniform", "fixed", "behavior", "oracle"),
    )
    names = ("random", "fixed", "behavior", "oracle")
    table.add_row(*(number(_mean([getattr(task, name) for task in result.tasks])) for name in names))
    return table


def _values(task: "TaskResult", score: str, *, with_success: bool) -> list[float | None]:
    values = [task.random, task.oracle, task.final, task.shuffled]
    values.append(task.regret if score == "regret" else task.normalized)
    return [*values, task.success] if with_success else values


def split_words(split: str) -> str:
    """What a task of a split is called."""
    return "training task" if split == "train" else "test task"


def _score(results: Sequence["Evaluation"]) -> str:
    """The score to print: the regret if the environment has an oracle, else the normalized return."""
    tasks = [task for result in results for task in result.tasks]
    return "regret" if any(task.regret is not None for task in tasks) else "normalized"


def _with_success(results: Sequence["Evaluation"]) -> bool:
    return any(task.success is not None for result in results for task in result.tasks)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


@click.command()
@click.argument("run_folder", metavar="RUN", type=PATH)
@click.option(
    "--protocol",
    type=PROTOCOL_OR_ALL,
    show_default="the run's",
    help="Adaptation protocol; `all` compares those on test tasks.",
)
@click.option(
    "--dataset", type=PATH, metavar="FOLDER", help="Folder of the run's dataset, if the dataset was moved."
)
@click.option(
    "--episodes", type=COUNT, show_default="the run's", help="Number of adaptation episodes per task."
)
@click.option(
    "--random-episodes",
    type=INDEX,
    show_default="the run's",
    help="How many of them form the first stage of `paper` and `idaq_literal`.",
)
@click.option(
    "--repeats",
    type=COUNT,
    show_default="the run's",
    help="How many times a protocol with a random first stage is run.",
)
@click.option(
    "--plot",
    type=FILE,
    metavar="FILE",
    help="Also draw the paths of the adapted policy to a .png, .svg or .pdf file (point robots).",
)
@output_options
def evaluate(
    run_folder: Path,
    protocol: str | None,
    dataset: Path | None,
    episodes: int | None,
    random_episodes: int | None,
    repeats: int | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Adapt the policy of RUN to the test tasks, and evaluate it.

    The protocol chooses the trajectories that the policy adapts to: trajectories that it collects on the
    test task, stored trajectories of the test task, or stored trajectories of training tasks. `offline_train`
    evaluates in training tasks, which shows whether a policy fails on new tasks alone; `all` leaves it out.

    The returns are compared with the controls of the dataset (`tcmrl controls`), which are measured once, and
    with the same policy under the contexts of other tasks. Returns are undiscounted. With --protocol all,
    --json prints a list of documents.

    --plot draws one final episode in every test task, after adaptation and under another task's context.

    \b
    Examples:
      tcmrl evaluate runs/point-robot-tcmrl-seed0
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol all --json
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol offline_train
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --plot paths.png
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --repeats 10
    """
    from tcmrl_algo import evaluate_run, open_run

    if plot is not None and protocol == ALL_PROTOCOLS:
        raise click.UsageError("--plot draws one protocol; name it by --protocol")
    with StageProgress() as progress:
        results = []
        for name in _protocols(progress) if protocol == ALL_PROTOCOLS else [protocol]:

            def show(stage: str, done: int, total: int, name: str | None = name) -> None:
                label = f"{name} {stage}" if name else stage
                progress.update(label, done=done, total=total, unit="episodes")

            results.append(
                evaluate_run(
                    run_folder,
                    protocol=name,
                    dataset_path=dataset,
                    episodes=episodes,
                    random_episodes=random_episodes,
                    repeats=repeats,
                    plot=plot,
                    report=show,
                )
            )
    if as_json:
        documents = [result.to_json() for result in results]
        print_json(documents if protocol == ALL_PROTOCOLS else documents[0])
        return
    for table in score_tables(results):
        print_table(table)
    if plot is not None:
        remark(f"picture written to {plot}")
    notes = [
        FIXED,
        BEHAVIOR,
        OTHER,
        SCORES[_score(results)],
        *([PRIVILEGED] if results[0].privileged else []),
    ]
    footnotes(*notes)
    run = open_run(run_folder)
    step = run.checkpoints()[-1].step
    if step < run.record.steps:
        remark(f"This run was interrupted: it has {step:,} of {run.record.steps:,} steps.")


def _protocols(progress: StageProgress) -> list[str]:
    """Names of the protocols on test tasks that can be loaded; reports those that cannot."""
    from tcmrl_algo import PROTOCOLS

    for error in PROTOCOLS.broken().values():
        progress.note(f"left out: {error}")
    return [name for name, protocol in PROTOCOLS.working().items() if protocol.split == "test"]


COLUMNS = ("uniform", "fixed_snapshot", "fixed_target", "behavior", "oracle")


@click.command()
@DATASET
@output_options
def controls(dataset: Path, as_json: bool) -> None:
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

    with StageProgress() as progress:
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
    footnotes(*_fitted(found), FIXED, BEHAVIOR)


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
