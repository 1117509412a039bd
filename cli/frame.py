"""What all commands share: options, one-line errors, exit codes, JSON and tables."""

import contextlib
import io
import json
import os
import shlex
import shutil
import signal
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import ENDING, leave_out_compiler, open_closed_streams, sleep_soon
from tcmrl_data.foundation.plugins import missing_package

from .groups import GONE, gone

if TYPE_CHECKING:
    from rich.table import Table

Command = TypeVar("Command", bound=Callable[..., Any])

DONE, INCOMPLETE, BAD_INPUT = 0, 1, 2
"""Exit codes: success; failed check or incomplete work; bad usage or bad input."""

SPANS = ((86_400, "d", 3_600, "h"), (3_600, "h", 60, "min"), (60, "min", 1, "s"))
"""Units of time, longest first: seconds and name of the unit and of the smaller unit printed after it."""

QUIET = "tcmrl.quiet"
"""Where the context of a command keeps that it is to be quiet."""

INTERRUPTED = "interrupted; run the same command again"

PIPE_WIDTH = 250
"""Width of tables that are not printed to a terminal, in columns."""

ONE_DECIMAL = 10_000.0
"""Smallest number that is printed with one decimal; tables of five-digit returns then fit 80 columns."""

FOLDED_WIDTH = 12
"""Smallest width of a column that folds its text on a narrow terminal."""


def main_program(command: click.Command) -> NoReturn:
    """Runs this process's command line and exits; Ctrl-C, SIGTERM or SIGHUP raises KeyboardInterrupt once.

    Further signals are ignored, because they would interrupt the cleanup.
    """
    open_closed_streams()
    leave_out_compiler()
    sleep_soon()
    obeyed = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal obeyed
        if not obeyed:
            obeyed = True
            raise KeyboardInterrupt

    for number in ENDING:
        # A shell ignores these signals for background jobs, as nohup does; that must stay so.
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, interrupt)
    try:
        code = run(command)
    except Exception:
        if not obeyed:
            raise
        code = _fail(INTERRUPTED, INCOMPLETE)  # an interrupted library may raise anything
    if obeyed:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)  # our handler does not work while the interpreter exits
    sys.exit(code)


def run(command: click.Command, arguments: Sequence[str] | None = None) -> int:
    """Runs a command line and returns its exit code; errors become one line on standard error.

    Args:
        command: the root command.
        arguments: the arguments after the program's name; None takes those of this process.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # prints question marks on a terminal without Unicode
    typed = sys.argv[1:] if arguments is None else list(arguments)
    try:
        result = command.main(args=typed, prog_name=command.name, standalone_mode=False, obj=typed)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return BAD_INPUT
    except click.UsageError as error:
        path = str(error.ctx.command_path if error.ctx else command.name)
        if isinstance(error, click.NoSuchOption) and f"{path} {error.option_name}" in GONE:
            return _fail(gone(f"{path} {error.option_name}"), BAD_INPUT)
        return _fail(f"{error.format_message()} See `{path} --help`.", BAD_INPUT)
    except click.ClickException as error:
        return _fail(error.format_message(), BAD_INPUT)
    except TcmrlError as error:
        return _fail(str(error), BAD_INPUT)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("tcmrl"):
            raise
        return _fail(f"this command {missing_package(error)}", BAD_INPUT)
    except click.Abort:
        return _fail(INTERRUPTED, INCOMPLETE)
    except OSError as error:
        place = error.filename or shlex.join([str(command.name), *typed])
        return _fail(f"{place}: {error.strerror or error}", BAD_INPUT)
    return result if isinstance(result, int) else DONE


def fail_incomplete(message: str) -> None:
    """Ends the running command with exit code 1 and a one-line error."""
    click.get_current_context().exit(_fail(message, INCOMPLETE))


def typed_command(*more: str) -> str:
    """The running command as the user typed it, with the arguments in `more` that it does not have yet."""
    context = click.get_current_context().find_root()
    return shlex.join(
        [
            str(context.info_name),
            *context.obj,
            *(argument for argument in more if argument not in context.obj),
        ]
    )


def same_command(out: Path) -> str:
    """The message that finished work in a folder is kept, and that the typed command continues it."""
    return f"finished work is kept in {out}; to continue, run `{typed_command()}` again"


@contextlib.contextmanager
def stopped_by_signals(how_to_continue: Callable[[], str]) -> Iterator[None]:
    """Turns Ctrl-C and SIGTERM during long work into a one-line error with exit code 1.

    Args:
        how_to_continue: called after the work has stopped; returns the state of the work and the command
            that continues it.
    """
    try:
        yield
    except KeyboardInterrupt:
        fail_incomplete(f"interrupted; {how_to_continue()}")


def _be_quiet(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    context.meta[QUIET] = value


QUIET_OPTION = click.option(
    "--quiet", is_flag=True, expose_value=False, callback=_be_quiet, help="Print only results and errors."
)


def is_quiet() -> bool:
    """Whether the running command was given `--quiet`."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(QUIET))


def output_options(command: Command) -> Command:
    """Adds `--json` and `--quiet`."""
    return click.option(
        "--json", "as_json", is_flag=True, help="Print one JSON document on standard output."
    )(QUIET_OPTION(command))


def print_json(document: Any) -> None:
    """Prints one JSON document on standard output; paths become text."""
    click.echo(json.dumps(document, indent=2, allow_nan=False, default=os.fspath))


def print_table(table: "Table") -> None:
    """Prints a table on standard output, with the width of the terminal, or at full width to a pipe.

    Numbers are never cut: if the columns do not fit, the lines are longer than the width of the terminal.
    """
    from rich.console import Console

    in_terminal = sys.stdout.isatty()
    console = Console(width=None if in_terminal else PIPE_WIDTH, markup=False, emoji=False, highlight=False)
    for column in table.columns:
        if column.no_wrap:
            texts = (str(column.header), *map(str, column.cells))
            column.min_width = max(len(line) for text in texts for line in text.split("\n"))
    folded = [column for column in table.columns if column.overflow == "fold"]
    for column in folded:
        column.max_width = column.min_width  # rich takes a word for something that cannot be folded
    width = max(console.width, console.measure(table).minimum)
    for column in folded:
        column.max_width = None
    title, table.title = table.title or "", None
    with console.capture() as capture:
        console.print(title, style="bold")  # apart: a title of the table wraps at the table's width
        console.print(table, width=width, crop=False)
    lines = capture.get().splitlines()
    click.echo("\n".join(lines if in_terminal else map(str.rstrip, lines)))


def make_table(
    title: str, *, columns: Iterable[str], text: Iterable[str] = (), long_text: Iterable[str] = ()
) -> "Table":
    """An empty table.

    Args:
        title: printed above the table.
        columns: headings from left to right.
        text: columns of text, aligned left; all other columns hold numbers, aligned right.
        long_text: like `text`, but folded into lines if the terminal is narrow.
    """
    from rich import box
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    texts, long_texts = set(text), set(long_text)
    for column in columns:
        if column in long_texts:
            table.add_column(column, overflow="fold", min_width=FOLDED_WIDTH)
        else:
            table.add_column(column, justify="left" if column in texts else "right", no_wrap=True)
    return table


def print_rows(
    title: str,
    columns: Iterable[str],
    rows: Iterable[Iterable[str]],
    *,
    text: Iterable[str] = (),
    long_text: Iterable[str] = (),
) -> None:
    """Prints a table of `make_table` with these rows; a shorter row leaves the last cells empty."""
    table = make_table(title, columns=columns, text=text, long_text=long_text)
    for row in rows:
        table.add_row(*row)
    print_table(table)


def print_by_step(
    title: str, columns: Iterable[str], rows: Iterable[tuple[Any, ...]], *, long_text: Iterable[str] = ()
) -> None:
    """Prints rows of step, split and further cells; a step that the row before has too is left out."""
    shown, before = [], None
    for step, *cells in rows:
        shown.append(("" if step == before else f"{step:,}", *cells))
        before = step
    print_rows(title, ["step", "split", *columns], shown, text=["split"], long_text=long_text)


def print_properties(title: str, properties: Mapping[str, str]) -> None:
    """Prints a table of names and values, which may be long."""
    print_rows(title, ["property", "value"], properties.items(), text=["property"], long_text=["value"])


def remark(message: str) -> None:
    """Prints a message that is not a result on standard error, unless `--quiet` is given."""
    if not is_quiet():
        click.echo(message, err=True)


def footnotes(*notes: str) -> None:
    """Prints what the words of a table mean on standard error: in a terminal, lines as wide as it is."""
    for note in notes:
        width = shutil.get_terminal_size().columns if sys.stderr.isatty() else PIPE_WIDTH
        remark(textwrap.fill(note, width, subsequent_indent="  "))


def next_commands(*commands: Sequence[str | Path]) -> None:
    """Suggests commands; each can be copied to a shell as it is printed."""
    for command in commands:
        remark(f"Next: {shlex.join(map(str, command))}")


def number(value: float | None) -> str:
    """Two decimals, or one from 10,000 on; a dash for None."""
    if value is None:
        return "–"
    return f"{value:,.1f}" if abs(value) >= ONE_DECIMAL else f"{value:,.2f}"


def duration(seconds: float) -> str:
    """A duration in its two largest units, such as `3 min 20 s`."""
    whole = round(seconds)
    for long, name, short, short_name in SPANS:
        if whole >= long:
            return f"{whole // long} {name} {whole % long // short} {short_name}"
    return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"


def _fail(message: str, code: int) -> int:
    click.echo(f"Error: {printable(' '.join(message.split()))}", err=True)
    return code
