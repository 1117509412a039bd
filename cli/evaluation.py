"""`tcmrl evaluate`: adapt a run to the test tasks, and show how well it did."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import click

from .frame import make_table, number, output_options, print_json, print_table, remark
from .progress import StageProgress

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Evaluation

Protocol = Literal["paper", "offline", "idaq"]
OTHER = "other: the same policy under other tasks' contexts"
SCORES = {
    "regret": "regret: oracle - adapted",
    "normalized": "normalized: 0 is uniform actions, 1 the best behavior policy",
}


def score_table(results: Sequence["Evaluation"]) -> "Table":
    """One row per test task and one of means; under each protocol what adaptation and its control reach."""
    tasks = [task for each in results for task in each.tasks]
    with_success = any(task.success is not None for task in tasks)
    score = _score(results)
    parts = ("adapted", "other", score, *(("success",) if with_success else ()))
    columns = ["task", "uniform", "oracle"]
    columns += [f"{each.protocol}\n{part}" for each in results for part in parts]
    first = results[0]
    title = f"{first.algorithm} on {first.environment}, seed {first.seed}: returns on the test tasks"
    table = make_table(title, columns=columns, text=("task",))
    rows = []
    for index, task in enumerate(first.tasks):
        values = [task.random, task.oracle]
        for each in results:
            result = each.tasks[index]
            values += [result.final, result.shuffled]
            values += [result.regret if score == "regret" else result.normalized]
            values += [result.success] if with_success else []
        rows.append(values)
        table.add_row(str(task.task), *(number(value) for value in values))
    table.add_section()
    table.add_row("mean", *(number(_mean(column)) for column in zip(*rows, strict=True)))
    return table


def _score(results: Sequence["Evaluation"]) -> str:
    """What is said of a return: how far it is from the oracle where there is one."""
    tasks = [task for each in results for task in each.tasks]
    return "regret" if any(task.regret is not None for task in tasks) else "normalized"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [each for each in values if each is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


@click.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--protocol",
    type=click.Choice([*get_args(Protocol), "all"]),
    help="How to adapt; the recipe's choice if left out. `all` runs the three and compares them.",
)
@click.option(
    "--dataset",
    type=click.Path(path_type=Path),
    help="The dataset the run was trained on, if it has moved.",
)
@click.option(
    "--episodes", type=click.IntRange(min=1), help="Adaptation episodes per task; the recipe's if left out."
)
@output_options
def evaluate(
    run_folder: Path,
    protocol: Protocol | Literal["all"] | None,
    dataset: Path | None,
    episodes: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Adapt the policy in RUN to the test tasks, and score it beside its controls.

    \b
    paper    uniform actions first, then the policy, its context growing by episode
    offline  contexts from the test tasks' stored trajectories
    idaq     contexts of training tasks first; the best-return episode's is kept

    Controls: uniform actions, the oracle, and other tasks' contexts. Returns are undiscounted.
    With --protocol all, --json prints a list of the three documents.

    \b
    Examples:
      tcmrl evaluate runs/point-robot-tcmrl-seed0
      tcmrl evaluate runs/point-robot-tcmrl-seed0 --protocol all --json
    """
    from tcmrl_algo import evaluate_run

    chosen: Sequence[Protocol | None] = get_args(Protocol) if protocol == "all" else [protocol]
    results = []
    with StageProgress(quiet=quiet) as progress:
        for each in chosen:
            label = f"{each} " if each else ""

            def show(stage: str, done: int, total: int, label: str = label) -> None:
                progress.update(label + stage, done=done, total=total, unit="episodes")

            results.append(
                evaluate_run(run_folder, protocol=each, dataset_path=dataset, episodes=episodes, report=show)
            )
    if as_json:
        documents = [each.to_json() for each in results]
        print_json(documents if protocol == "all" else documents[0])
        return
    print_table(score_table(results))
    remark(f"{OTHER}; {SCORES[_score(results)]}", quiet=quiet)
