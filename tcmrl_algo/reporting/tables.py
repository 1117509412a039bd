"""Tables of a report, as Markdown and as CSV."""

from collections.abc import Sequence
from dataclasses import dataclass

from tcmrl_algo.experiment.aggregate import summarize
from tcmrl_algo.experiment.results import table_text

Cell = str | float | int | None


@dataclass(frozen=True)
class Table:
    """A named table; None is a missing value.

    Attributes:
        name: name of the CSV file.
        columns: headings.
        rows: cells of the rows, one per column.
    """

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def markdown(self) -> str:
        """The table as Markdown, with four significant digits."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        return "\n".join(f"| {' | '.join(_text(cell) for cell in line)} |" for line in lines)

    def csv(self) -> str:
        """The table as CSV, with all digits."""
        return table_text([dict(zip(self.columns, row, strict=True)) for row in self.rows], self.columns)


def across_seeds(values: Sequence[float | None]) -> tuple[Cell, Cell, Cell]:
    """Mean, interquartile mean, and interval as text, or the values of all seeds if they are too few."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None, None, None
    summary = summarize(known)
    return summary.mean, summary.iqm, interval_text(summary.values, summary.low, summary.high)


def interval_text(values: Sequence[float], low: float | None, high: float | None) -> str:
    """The 95% interval as text, or the values of all seeds if there is none."""
    if low is None or high is None:
        return "seeds: " + ", ".join(f"{value:.4g}" for value in values)
    return f"{low:.4g} to {high:.4g}"


def _text(cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:,.0f}" if abs(cell) >= 10_000 else f"{cell:.4g}"
    return str(cell).replace("|", "\\|")
