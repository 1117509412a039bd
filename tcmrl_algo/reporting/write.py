"""Writes a report: Markdown, HTML, CSV and PNG, and the compact results from which it can be made again."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.experiment.results import error_file, result_file
from tcmrl_algo.experiment.spec import folder_name
from tcmrl_algo.reporting.claims import Verdict
from tcmrl_algo.reporting.compose import Block, Page, Picture, compose
from tcmrl_algo.reporting.html import page_html
from tcmrl_algo.reporting.measuring import Measured, measure_source
from tcmrl_algo.reporting.rows import add_rows
from tcmrl_algo.reporting.sources import natural_order, read_sources
from tcmrl_algo.reporting.tables import Table
from tcmrl_data.foundation.disk import make_folders, replace_file
from tcmrl_data.foundation.records import write_record

ReportProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class WrittenReport:
    """Files and verdicts of a report.

    Attributes:
        report: the Markdown file.
        files: all files, including `report`.
        verdicts: verdicts on the claims of the experiments.
    """

    report: Path
    files: tuple[Path, ...]
    verdicts: tuple[Verdict, ...]


def ignore(stage: str, done: int, total: int) -> None:
    """Ignores progress."""


def write_report(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    datasets: Sequence[str | Path] = (),
    rows: str | Path | None = None,
    report: ReportProgress = ignore,
) -> WrittenReport:
    """Writes a report on results folders of experiments, on run folders, and on earlier reports.

    Beside the report stand the compact results of all runs, so that the report is itself a results folder
    from which the same report can be written, without checkpoints and datasets.

    Args:
        paths: the folders; all run folders are in one section.
        out: folder of the report, created if needed; files of an earlier report are replaced.
        datasets: folders of datasets that were moved after the training of the runs.
        rows: a table, `runs.csv`, to which the runs of results folders are added.
        report: called with the name of a stage, the amount done and the total amount.

    Raises:
        CheckpointError: not a results or run folder, no finished run in it, a dataset of no run, or `rows`
            is no table.

    Example:
        >>> write_report(["results/perspectives"], "reports/perspectives").verdicts  # doctest: +SKIP
    """
    out = Path(out)
    measured = measure_paths(paths, datasets=datasets, report=report)
    if rows is not None:
        add_rows(Path(rows), [found for _, found in measured])
    page, judged = compose(measured, out)
    make_folders(out)
    records = [
        file
        for name, found in measured
        for file in _write_records(out if len(measured) == 1 else out / name, found)
    ]
    for done, (file, draw) in enumerate(page.figures.items(), start=1):
        if draw is not None:
            draw(out / file)
        report("drawing figures", done, len(page.figures))
    for table in page.tables:
        replace_file(out / f"{table.name}.csv", table.csv().encode())
    replace_file(out / "report.md", page_text(page).encode())
    replace_file(out / "report.html", page_html(page).encode())
    names = ["report.md", "report.html", *(f"{table.name}.csv" for table in page.tables), *page.figures]
    verdicts = tuple(itertools.chain.from_iterable(judged.values()))
    return WrittenReport(out / "report.md", (*(out / name for name in names), *records), verdicts)


def measure_paths(
    paths: Sequence[str | Path], *, datasets: Sequence[str | Path] = (), report: ReportProgress = ignore
) -> list[tuple[str, Measured]]:
    """The experiments in folders with compact results, by unique names, in natural order.

    Raises:
        CheckpointError: as `write_report`.
    """
    sources = read_sources(
        [Path(path) for path in paths], report, datasets=[Path(folder) for folder in datasets]
    )
    sources.sort(key=lambda source: natural_order(source.experiment.name))
    measured: list[tuple[str, Measured]] = []
    for number, source in enumerate(sources):
        name = source.experiment.name
        if any(earlier.experiment.name == name for earlier in sources[:number]):
            name = f"{name}-{number}"
        measured.append((name, measure_source(source)))
        report("measuring", number + 1, len(sources))
    return measured


def page_text(page: Page) -> str:
    """The content of `report.md`."""
    return "\n\n".join(map(_markdown, page.blocks)) + "\n"


def _markdown(block: Block) -> str:
    if isinstance(block, Picture):
        return f"![{block.caption}]({block.file})"
    return block.markdown() if isinstance(block, Table) else block


def _write_records(folder: Path, found: Measured) -> list[Path]:
    """Writes a results folder with compact results; the files."""
    make_folders(folder)
    source, files = found.source, [folder / "experiment.json"]
    write_record(files[0], source.experiment.without_places())
    for result in source.runs:
        files.append(result_file(folder / "runs" / result.id))
        make_folders(files[-1].parent)
        replace_file(files[-1], f"{result.model_dump_json()}\n".encode())  # in the order of its protocols
    for environment, returns in source.datasets.items():
        files.append(folder / "datasets" / f"{folder_name(environment)}.json")
        make_folders(files[-1].parent)
        write_record(files[-1], returns)
    for name, error in source.failed.items():
        files.append(error_file(folder / "runs" / name))
        make_folders(files[-1].parent)
        replace_file(files[-1], f"{error}\n".encode())
    return files
