"""The table that `tcmrl evaluate` ends with."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from .frame import make_table, number

if TYPE_CHECKING:
    from rich.table import Table

    from tcmrl_algo import Evaluation

EXPLANATION = (
    "other: the same policy under other tasks' contexts; regret: oracle - adapted; "
    "normalized: 0 is uniform actions, 1 the best behavior policy"
)


def score_table(results: Sequence["Evaluation"]) -> "Table":
    """One row per test task and one of means; under each protocol what adaptation and its control reach."""
    tasks = [task for each in results for task in each.tasks]
    with_success = any(task.success is not None for task in tasks)
    score = "regret" if any(task.regret is not None for task in tasks) else "normalized"
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


def _mean(values: Sequence[float | None]) -> float | None:
    known = [each for each in values if each is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None
