"""Progress of long work on standard error: bars on a terminal, a plain line every few seconds otherwise."""

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

import click

from .frame import duration

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

PLAIN_SECONDS = 5.0
"""Plain lines of one stage are at least this far apart."""


class StageProgress:
    """Shows how far the stages of a job are, with rate and time left.

    Example:
        >>> with StageProgress(quiet=True) as progress:
        ...     progress.update("training", done=10, total=100, unit="steps")
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._bars: Progress | None = None
        self._bar_of: dict[str, TaskID] = {}
        self._started: dict[str, tuple[float, float]] = {}
        self._printed: dict[str, float] = {}
        self._ended: set[str] = set()

    def __enter__(self) -> Self:
        if not self._quiet and sys.stderr.isatty():
            self._bars = _bars()
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def update(self, stage: str, *, done: float, total: float, unit: str, detail: str = "") -> None:
        """Says how much of a stage is done, in its unit; stages appear with their first update.

        Args:
            stage: its name.
            done: how much is done.
            total: how much there is to do.
            unit: of both.
            detail: what else there is to say, in a few words.
        """
        if self._quiet or total <= 0:
            return
        if self._bars is None:
            self._print_line(stage, done, total, unit, detail)
            return
        if stage not in self._bar_of:
            self._bar_of[stage] = self._bars.add_task(stage, total=total, unit=unit, detail="")
        self._bars.update(self._bar_of[stage], completed=done, total=total, detail=detail)

    def note(self, message: str) -> None:
        """Prints a line that stays, above the bars where there are bars."""
        if self._quiet:
            return
        if self._bars is not None:
            self._bars.console.print(message, markup=False, highlight=False)
        else:
            click.echo(message, err=True)

    def _print_line(self, stage: str, done: float, total: float, unit: str, detail: str) -> None:
        now = time.monotonic()
        start, done_at_start = self._started.setdefault(stage, (now, done))
        ended, last = done >= total, self._printed.get(stage, start)
        is_due = now - last >= PLAIN_SECONDS or (ended and now > start)
        if not is_due or stage in self._ended:
            return
        self._printed[stage] = now
        if ended:
            self._ended.add(stage)
        rate = (done - done_at_start) / max(now - start, 1e-9)
        left = f", {duration((total - done) / rate)} left" if rate > 0 and not ended else ""
        more = f", {detail}" if detail else ""
        text = f"{stage}: {done:,.0f} of {total:,.0f} {unit}, {rate:,.1f} {unit}/s{more}{left}"
        click.echo(text, err=True)


def _bars() -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class AmountColumn(ProgressColumn):
        """Done, total and rate in the stage's unit, and the stage's detail."""

        def render(self, task: Task) -> Text:
            rate = "" if not task.speed else f"  {task.speed:,.1f}/s"
            detail = f"  {task.fields['detail']}" if task.fields["detail"] else ""
            return Text(f"{task.completed:,.0f}/{task.total or 0:,.0f} {task.fields['unit']}{rate}{detail}")

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        AmountColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
    )
