"""Tables of a report: once as Markdown, once as CSV."""

from collections.abc import Sequence
from dataclasses import dataclass

from tcmrl_algo.experiment.aggregate import summarize
from tcmrl_algo.experiment.results import table_text

Cell = str | float | int | None


@dataclass(frozen=True)
class Table:
    """A named table; None stands for a value that does not exist.

    Attributes:
        name: of its CSV file.
        columns: headings.
        rows: cells, as many as columns.
    """

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def markdown(self) -> str:
        """The table for reading, numbers with four significant digits."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        return "\n".join(f"| {' | '.join(_text(each) for each in line)} |" for line in lines)

    def csv(self) -> str:
        """The table for programs, numbers in full."""
        return table_text([dict(zip(self.columns, row, strict=True)) for row in self.rows], self.columns)


def across_seeds(values: Sequence[float | None]) -> tuple[Cell, Cell, Cell]:
    """Mean, interquartile mean, and the interval as words; the seeds themselves where they are too few."""
    known = [each for each in values if each is not None]
    if not known or len(known) < len(values):
        return None, None, None
    summary = summarize(known)
    return summary.mean, summary.iqm, interval_text(summary.values, summary.low, summary.high)


def interval_text(values: Sequence[float], low: float | None, high: float | None) -> str:
    """The 95% interval, or the seeds."""
    if low is None or high is None:
        return "seeds: " + ", ".join(f"{each:.4g}" for each in values)
    return f"{low:.4g} to {high:.4g}"


def _text(cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:,.0f}" if abs(cell) >= 10_000 else f"{cell:.4g}"
    return str(cell).replace("|", "\\|")
