"""Recomputes what the documentation says of results, from the committed documents of the single runs.

`python benchmarks/recompute.py` rewrites every report below docs/results and every marked number and table
of the pages; with `--check` it changes nothing, names what differs, and ends with exit code 1 if anything
does. No dataset and no checkpoint is needed. `tcmrl_algo/reporting/pages.py` explains the marks.
"""

import argparse
import contextlib
import dataclasses
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tcmrl_cli.evaluation import score_tables
from tcmrl_cli.experiments import result_tables
from tcmrl_cli.frame import print_table

from tcmrl_algo import Evaluation, TaskResult
from tcmrl_algo.reporting.compose import compose
from tcmrl_algo.reporting.leaderboard import leaderboard, listed_folders
from tcmrl_algo.reporting.pages import Pages, unmarked_numbers
from tcmrl_algo.reporting.sources import read_sources
from tcmrl_algo.reporting.write import ignore, measure_paths, page_text

if TYPE_CHECKING:
    from rich.table import Table

Kind = TypeVar("Kind", Evaluation, TaskResult)
ROOT = Path(__file__).parents[1]
RECOMPUTED = ("docs/results/learning.md",)
"""Pages in whose prose every decimal number has a mark."""


def main() -> None:
    """Rewrites or checks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="change nothing")
    arguments = parser.parse_args()
    problems = list(unmarked(ROOT))
    for file, text in recomputed(ROOT):
        if file.read_text(encoding="utf-8") != text:
            if arguments.check:
                problems.append(f"{file.relative_to(ROOT)} differs from its results")
            else:
                file.write_text(text, encoding="utf-8")
                print(f"{file.relative_to(ROOT)}: rewritten")
    print("\n".join(problems))
    sys.exit(1 if problems else 0)


def unmarked(root: Path) -> Iterator[str]:
    """Decimal numbers that have no mark, in pages that may have none."""
    for name in RECOMPUTED:
        for number in unmarked_numbers((root / name).read_text(encoding="utf-8")):
            yield f"{name}: {number} has no mark"


def recomputed(root: Path) -> Iterator[tuple[Path, str]]:
    """Every file of the documentation that is made of results, with what they give."""
    results = root / "docs/results"
    for report in sorted(results.glob("*/report.md")):
        page, _ = compose(measure_paths([report.parent]), report.parent)
        yield report, page_text(page)
        yield from ((report.parent / f"{table.name}.csv", table.csv()) for table in page.tables)
    for record in sorted(results.glob("*/leaderboard.json")):
        page = leaderboard(read_sources(listed_folders(record), ignore), record.parent)
        yield record.with_suffix(".md"), page_text(page)
        yield from ((record.parent / f"{table.name}.csv", table.csv()) for table in page.tables)
    pages = Pages(results, {"evaluation": evaluation, "shown": shown})
    for file in [
        root / "README.md",
        *(page for page in sorted(root.glob("docs/**/*.md")) if not page.match("docs/results/*/report.md")),
    ]:
        yield file, pages.rewritten(file.read_text(encoding="utf-8"))


def evaluation(pages: Pages, file: str) -> str:
    """What `tcmrl evaluate --protocol all` prints of its JSON documents: the first three tables."""
    found = [
        _record(Evaluation, document | {"tasks": [_record(TaskResult, task) for task in document["tasks"]]})
        for document in pages.document(file)
    ]
    run = f"results/{Path(file).parent}/runs/point-robot--tcmrl--seed{found[0].seed}"
    return _console(f"$ tcmrl evaluate {run} --protocol all", *score_tables(found)[:3])


def shown(pages: Pages, folder: str) -> str:
    """What `tcmrl experiment` prints of finished runs."""
    source = pages.source(folder)
    (environment,) = source.environments()
    command = f"$ tcmrl experiment {source.experiment.name} --data data/demo"
    return _console(command, *result_tables(environment, source.results(environment)))


def _record(kind: type[Kind], values: dict[str, Any]) -> Kind:
    """A dataclass of a document that may be older than some of its fields."""
    return kind(**{field.name: values.get(field.name) for field in dataclasses.fields(kind)})  # type: ignore[arg-type]


def _console(command: str, *tables: "Table") -> str:
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        for table in tables:
            print_table(table)
    return f"```console\n{command}\n{output.getvalue().rstrip()}\n```"


if __name__ == "__main__":
    main()
