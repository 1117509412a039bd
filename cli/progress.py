"""Progress of long work on standard error: bars on a terminal, a plain line every few seconds otherwise."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

import click

from .frame import duration, is_quiet, same_command, stopped_by_signals

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

Made = TypeVar("Made")
PartsProgress = Callable[[int, int], None]
"""Takes the number of parts that are done, and of all."""

PLAIN_SECONDS = 5.0
"""Least time between two plain lines of a stage."""

KNOWN_SECONDS, KNOWN_SHARE, LONG_SECONDS = 3.0, 0.05, 60.0
"""A pace is known after 3 s that covered 5% of a stage, or after a minute."""


SHORTEST_BAR = 10
"""Least width of a bar and its margins next to a stage's detail, in columns."""


class Pace:
    """Rate and remaining time of a stage, measured from its first progress on.

    The time before that, such as the start of worker processes, does not count.
    """

    def __init__(self, done: float) -> None:
        self._before = done
        self._first: tuple[float, float] | None = None
        self._latest = (0.0, done)

    def update(self, done: float) -> None:
        """Records the amount of work done so far."""
        if done > self._before:
            self._latest = (time.monotonic(), done)
            self._first = self._first or self._latest

    @property
    def rate(self) -> float | None:
        """Units per second; None if unknown."""
        if self._first is None or self._latest[0] <= self._first[0]:
            return None
        return (self._latest[1] - self._first[1]) / (self._latest[0] - self._first[0])

    def seconds_left(self, total: float) -> float | None:
        """Seconds until the stage ends; None until the pace is known."""
        if not self.rate or self._first is None:
            return None
        seconds, done = self._latest[0] - self._first[0], self._latest[1] - self._first[1]
        is_known = seconds >= KNOWN_SECONDS and done >= KNOWN_SHARE * (total - self._first[1])
        return (total - self._latest[1]) / self.rate if is_known or seconds >= LONG_SECONDS else None


class StageProgress:
    """Shows the progress of a job's stages, with rate and remaining time.

    Example:
        >>> with StageProgress() as progress:
        ...     progress.update("training", done=10, total=100, unit="steps")
    """

    def __init__(self) -> None:
        self._quiet = is_quiet()
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
        """Updates the progress of a stage; a stage appears with its first update.

        Args:
            stage: name of the stage.
            done: amount of work done.
            total: amount of work in all.
            unit: unit of `done` and `total`.
            detail: a short further text.
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
        """Prints a permanent line, above the bars if there are any."""
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


def with_progress(work: Callable[[PartsProgress], Made], *, stage: str, out: Path) -> Made:
    """Calls a function that reports its progress; Ctrl-C says what is kept in `out` and how to go on."""
    with stopped_by_signals(lambda: same_command(out)), StageProgress() as progress:
        return work(lambda done, total: progress.update(stage, done=done, total=total, unit="parts"))


def _rate(rate: float) -> str:
    return f"{rate:,.1f}" if rate < 100 else f"{rate:,.0f}"


def _bars() -> "Progress":
    """Progress bars of one line; on a narrow terminal the bar shrinks and the detail is omitted."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    console = Console(stderr=True)

    class AmountColumn(ProgressColumn):
        """Amounts done and in all, rate, remaining or total time, and detail of a stage."""

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
