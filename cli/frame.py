"""The frame around every command: options they share, one-line errors, exit codes, JSON and tables."""

import contextlib
import io
import json
import shlex
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.plain_files import printable

if TYPE_CHECKING:
    from rich.table import Table

Command = TypeVar("Command", bound=Callable[..., Any])

DONE, INCOMPLETE, BAD_INPUT = 0, 1, 2
"""Exit codes: done; a check failed or work is incomplete; bad usage or bad input."""

SPANS = ((86_400, "d", 3_600, "h"), (3_600, "h", 60, "min"), (60, "min", 1, "s"))
"""Seconds and name of a unit of time, and of the one shown beside it."""

INTERRUPTED = "interrupted; run the same command again"

PIPE_WIDTH = 250
"""Columns of a table that does not go to a terminal."""

FOLDED_WIDTH = 12
"""Columns that a folded text keeps where the terminal is narrow."""


def main_program(command: click.Command) -> NoReturn:
    """Runs this process's command line and exits; Ctrl-C and SIGTERM are obeyed once, in order.

    Further ones change nothing: they would break off the very work of stopping.
    """
    obeyed = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal obeyed
        if not obeyed:
            obeyed = True
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:  # a shell's background work stays there
            signal.signal(number, interrupt)
    try:
        code = run(command)
    except Exception:
        if not obeyed:
            raise
        code = _fail(INTERRUPTED, INCOMPLETE)  # a library that was broken off may raise anything
    if obeyed:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # a handler of ours would not outlive the interpreter's end
    sys.exit(code)


def run(command: click.Command, arguments: Sequence[str] | None = None) -> int:
    """Runs a command line and returns its exit code; errors become one line on standard error.

    Args:
        command: the root command.
        arguments: what follows the program's name; those of this process where None.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Unicode gets question marks
    typed = sys.argv[1:] if arguments is None else list(arguments)
    try:
        result = command.main(args=typed, prog_name=command.name, standalone_mode=False, obj=typed)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return BAD_INPUT
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else command.name
        return _fail(f"{error.format_message()} See `{path} --help`.", BAD_INPUT)
    except click.ClickException as error:
        return _fail(error.format_message(), BAD_INPUT)
    except TcmrlError as error:
        return _fail(str(error), BAD_INPUT)
    except click.Abort:
        return _fail(INTERRUPTED, INCOMPLETE)
    except OSError as error:
        place = error.filename or shlex.join([str(command.name), *typed])
        return _fail(f"{place}: {error.strerror or error}", BAD_INPUT)
    return result if isinstance(result, int) else DONE


def fail_incomplete(message: str) -> None:
    """Ends the running command with exit code 1 and one line that says what is not as it must be."""
    click.get_current_context().exit(_fail(message, INCOMPLETE))


def typed_command(*more: str) -> str:
    """The running command as it was typed, to be run again, with more arguments that it does not have yet."""
    context = click.get_current_context().find_root()
    return shlex.join(
        [str(context.info_name), *context.obj, *(each for each in more if each not in context.obj)]
    )


def same_command(out: Path) -> str:
    """That the command that was typed goes on with what it left in a folder."""
    return f"{out} keeps what is finished, to go on run `{typed_command()}` again"


@contextlib.contextmanager
def stopped_by_signals(go_on: Callable[[], str]) -> Iterator[None]:
    """Lets Ctrl-C and SIGTERM end long work in order, with one line.

    Args:
        go_on: says, once the work has stopped, what is left of it and which command goes on.
    """
    try:
        yield
    except KeyboardInterrupt:
        fail_incomplete(f"interrupted; {go_on()}")


def output_options(command: Command) -> Command:
    """Adds `--json` and `--quiet`."""
    as_json = click.option(
        "--json", "as_json", is_flag=True, help="Print one JSON document and nothing else on standard output."
    )
    quiet = click.option("--quiet", is_flag=True, help="No progress and no remarks, only results and errors.")
    return as_json(quiet(command))


def print_json(document: Any) -> None:
    """Prints one JSON document on standard output."""
    click.echo(json.dumps(document, indent=2, allow_nan=False))


def print_table(table: "Table") -> None:
    """Prints a table on standard output: as wide as the terminal, or as wide as it needs in a pipe.

    No number is cut: where the columns do not fit, lines are longer than the terminal is wide.
    """
    from rich.console import Console

    in_terminal = sys.stdout.isatty()
    console = Console(width=None if in_terminal else PIPE_WIDTH, markup=False, emoji=False, highlight=False)
    for column in table.columns:
        if column.no_wrap:
            texts = (str(column.header), *map(str, column.cells))
            column.min_width = max(len(line) for text in texts for line in text.split("\n"))
    width = max(console.width, console.measure(table).minimum)
    title, table.title = table.title or "", None
    with console.capture() as capture:
        console.print(title, style="bold")  # by itself: a title of the table would wrap at the table's width
        console.print(table, width=width, crop=False)
    lines = capture.get().splitlines()
    click.echo("\n".join(lines if in_terminal else map(str.rstrip, lines)))


def make_table(
    title: str, *, columns: Iterable[str], text: Iterable[str] = (), long_text: Iterable[str] = ()
) -> "Table":
    """An empty table.

    Args:
        title: stands above it.
        columns: headings, left to right.
        text: columns that hold words and align left; all others hold numbers and align right.
        long_text: like `text`, but broken into lines where the terminal is narrow.
    """
    from rich import box
    from rich.table import Table

    table = Table(
        title=title,
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    words, sentences = set(text), set(long_text)
    for column in columns:
        if column in sentences:
            table.add_column(column, overflow="fold", min_width=FOLDED_WIDTH)
        else:
            table.add_column(column, justify="left" if column in words else "right", no_wrap=True)
    return table


def remark(message: str, *, quiet: bool) -> None:
    """Says something that is no result, on standard error."""
    if not quiet:
        click.echo(message, err=True)


def number(value: float | None) -> str:
    """Two decimals; a dash where there is no value."""
    return "–" if value is None else f"{value:,.2f}"


def duration(seconds: float) -> str:
    """A time span in its two largest units, such as `3 min 20 s`."""
    whole = round(seconds)
    for long, name, short, short_name in SPANS:
        if whole >= long:
            return f"{whole // long} {name} {whole % long // short} {short_name}"
    return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"


def _fail(message: str, code: int) -> int:
    click.echo(f"Error: {printable(' '.join(message.split()))}", err=True)
    return code
