"""`tcmrl evaluate`: adapt the policy of a run to the test tasks and print its returns."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .frame import make_table, number, output_options, print_json, print_table, remark
from .places import RUN_PATH
from .plugins import ALL_PROTOCOLS, PROTOCOL
from .progress import StageProgress

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Evaluation, TaskResult

OTHER = "other: the same policy with the contexts of other tasks"
PRIVILEGED = "privileged: a control that observes the task parameters"
SCORES = {
    "regret": "regret: oracle - adapted",
    "normalized": "normalized: 0 is uniform actions, 1 the best behavior policy without its noise",
}
FIXED = "fixed: the best policy that acts the same in all tasks, fitted on the training tasks"
BEHAVIOR = "behavior: the best behavior policy of the task itself, without its noise"


def score_tables(results: Sequence["Evaluation"]) -> list["Table"]:
    """Tables of returns: controls, means by protocol if there are several, and test tasks by protocol."""
    first = results[0]
    mark = " (privileged)" if first.privileged else ""
    run = f"{first.algorithm}{mark} on {first.environment}, seed {first.seed}"
    score, with_success = _score(results), _with_success(results)

    def table(title: str, row_name: str) -> "Table":
        success = ("success",) if with_success else ()
        columns = (row_name, "uniform", "oracle", "adapted", "other", score, *success)
        return make_table(title, columns=columns, long_text=(row_name,))

    blocks = []
    means = table(f"{run}: means over {len(first.tasks)} test tasks", "protocol")
    for result in results:
        name = f"protocol {result.protocol}" if len(results) > 1 else f"{run}, {result.protocol}"
        block = table(f"{name}: returns by test task", "task")
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
    table = make_table(
        f"{result.environment}: controls, means over {len(result.tasks)} test tasks",
        columns=("uniform", "fixed", "behavior", "oracle"),
    )
    names = ("random", "fixed", "behavior", "oracle")
    table.add_row(*(number(_mean([getattr(task, name) for task in result.tasks])) for name in names))
    return table


def _values(task: "TaskResult", score: str, *, with_success: bool) -> list[float | None]:
    values = [task.random, task.oracle, task.final, task.shuffled]
    values.append(task.regret if score == "regret" else task.normalized)
    return [*values, task.success] if with_success else values


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
@click.argument("run_folder", metavar="RUN", type=RUN_PATH)
@click.option(
    "--protocol",
    type=PROTOCOL,
    show_default="the run's",
    help="Adaptation protocol; `all` evaluates every protocol and compares them.",
)
@click.option(
    "--dataset",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Folder of the run's dataset, if the dataset was moved.",
)
@click.option(
    "--episodes",
    type=click.IntRange(min=1),
    show_default="the run's",
    help="Number of adaptation episodes per task.",
)
@click.option(
    "--random-episodes",
    type=click.IntRange(min=0),
    show_default="the run's",
    help="How many of them form the first stage of `paper` and `idaq_literal`.",
)
@click.option(
    "--repeats",
    type=click.IntRange(min=1),
    show_default="the run's",
    help="How many times a protocol with a random first stage is run.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
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
    quiet: bool,
) -> None:
    """Adapt the policy of RUN to the test tasks, and evaluate it.

    The protocol chooses the trajectories that the policy adapts to: trajectories that it collects on the
    test task, stored trajectories of the test task, or stored trajectories of training tasks.

    The returns are compared with the controls of the dataset (`tcmrl controls`), which are measured once, and
    with the same policy under the contexts of other tasks. Returns are undiscounted. With --protocol all,
    --json prints a list of documents.

    --plot draws one final episode in every test task, after adaptation and under another task's context.

    \b
    Examples:
      tcmrl evaluate runs/point-robot-tcmrl-seed0
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol all --json
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol offline --plot paths.png
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol paper --random-episodes 2 --repeats 10
    """
    from tcmrl_algo import evaluate_run

    if plot is not None and protocol == ALL_PROTOCOLS:
        raise click.UsageError("--plot draws one protocol; name it by --protocol")
    with StageProgress(quiet=quiet) as progress:
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
    notes = [
        FIXED,
        BEHAVIOR,
        OTHER,
        SCORES[_score(results)],
        *([PRIVILEGED] if results[0].privileged else []),
    ]
    remark("; ".join(notes), quiet=quiet)


def _protocols(progress: StageProgress) -> list[str]:
    """Names of the protocols that can be loaded; reports the others."""
    from tcmrl_algo import PROTOCOLS

    for error in PROTOCOLS.broken().values():
        progress.note(f"left out: {error}")
    return list(PROTOCOLS.working())
