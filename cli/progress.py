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

KNOWN_SECONDS, KNOWN_SHARE, LONG_SECONDS = 3.0, 0.05, 60.0
"""A pace is known once it was seen for so long over this share of a stage, or over any share for a minute."""


SHORTEST_BAR = 10
"""Columns that a bar and the gaps beside it take at least where a stage's detail is shown."""


class Pace:
    """How fast a stage goes, and how long it still takes, from its first step forward on.

    What passes before that step, such as the start of worker processes, tells nothing about the pace.
    """

    def __init__(self, done: float) -> None:
        self._before = done
        self._first: tuple[float, float] | None = None
        self._latest = (0.0, done)

    def update(self, done: float) -> None:
        """Notes how much is done now."""
        if done > self._before:
            self._latest = (time.monotonic(), done)
            self._first = self._first or self._latest

    @property
    def rate(self) -> float | None:
        """Units per second; None where nothing is known."""
        if self._first is None or self._latest[0] <= self._first[0]:
            return None
        return (self._latest[1] - self._first[1]) / (self._latest[0] - self._first[0])

    def seconds_left(self, total: float) -> float | None:
        """Until the stage ends; None until the pace is known."""
        if not self.rate or self._first is None:
            return None
        seconds, done = self._latest[0] - self._first[0], self._latest[1] - self._first[1]
        seen = seconds >= KNOWN_SECONDS and done >= KNOWN_SHARE * (total - self._first[1])
        return (total - self._latest[1]) / self.rate if seen or seconds >= LONG_SECONDS else None


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
        self._paces: dict[str, Pace] = {}
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
        pace = self._paces.setdefault(stage, Pace(done))
        pace.update(done)
        rate, seconds = pace.rate, pace.seconds_left(total)
        left = duration(seconds) if seconds is not None and done < total else ""
        words = {"detail": detail, "rate": "" if rate is None else _rate(rate), "left": left}
        if self._bars is None:
            self._print_line(stage, done, total, unit, words)
            return
        if stage not in self._bar_of:
            self._bar_of[stage] = self._bars.add_task(stage, total=total, unit=unit, words=words)
        self._bars.update(self._bar_of[stage], completed=done, total=total, words=words)

    def note(self, message: str) -> None:
        """Prints a line that stays, above the bars where there are bars."""
        if self._quiet:
            return
        if self._bars is not None:
            self._bars.console.print(message, markup=False, highlight=False)
        else:
            click.echo(message, err=True)

    def _print_line(self, stage: str, done: float, total: float, unit: str, words: dict[str, str]) -> None:
        now = time.monotonic()
        ended, last = done >= total, self._printed.setdefault(stage, now)
        is_due = now - last >= PLAIN_SECONDS or (ended and now > last)
        if not is_due or stage in self._ended:
            return
        self._printed[stage] = now
        if ended:
            self._ended.add(stage)
        rate = f", {words['rate']} {unit}/s" if words["rate"] else ""
        detail = f", {words['detail']}" if words["detail"] else ""
        left = f", {words['left']} left" if words["left"] else ""
        click.echo(f"{stage}: {done:,.0f} of {total:,.0f} {unit}{rate}{detail}{left}", err=True)


def _rate(rate: float) -> str:
    return f"{rate:,.1f}" if rate < 100 else f"{rate:,.0f}"


def _bars() -> "Progress":
    """Bars of one line each; where the terminal is narrow, the bar gives way, and words are left out."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    console = Console(stderr=True)

    class AmountColumn(ProgressColumn):
        """Done and total in the stage's unit, its rate, the time that it still takes or took, its detail."""

        def render(self, task: Task) -> Text:
            words = task.fields["words"]
            text = f"{task.completed:,.0f}/{task.total or 0:,.0f} {task.fields['unit']}"
            text += f"  {words['rate']}/s" if words["rate"] else ""
            if task.finished_time is not None:
                text += f"  {duration(task.finished_time)}"
            elif words["left"]:
                text += f"  {words['left']} left"
            needed = len(task.description) + len(text) + len(words["detail"]) + SHORTEST_BAR
            return Text(f"{text}  {words['detail']}" if needed <= console.width else text)

    return Progress(
        TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        BarColumn(bar_width=None, table_column=Column(max_width=40)),
        AmountColumn(table_column=Column(no_wrap=True)),
        console=console,
    )
