"""Runs commands in terminals of a given width, real or pretended, and checks that their lines fit."""

import contextlib
import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from tcmrl_cli.frame import run

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
"""Colours, cursor moves and the like."""


@dataclass(frozen=True)
class Shown:
    """The output of a command in its terminals, without control codes.

    Attributes:
        code: its exit code.
        output: standard output, a terminal of its own.
        errors: standard error, another terminal of the same width.
    """

    code: int
    output: str
    errors: str


def in_terminal(
    program: str, *arguments: object, columns: int = 80, env: Mapping[str, str] | None = None
) -> Shown:
    """Runs an installed program, such as `tcmrl`, in pseudo-terminals of so many columns and 24 rows.

    Args:
        program: a script of this Python's installation.
        arguments: what follows the program's name.
        columns: width of both terminals.
        env: changes of the environment variables.
    """
    script = Path(sys.executable).with_name(program)
    return _show([str(script), *map(str, arguments)], columns, env or {})


def as_in_terminal(command: click.Command, *arguments: object, columns: int = 80) -> Shown:
    """Like `in_terminal`, in this process: the streams say that they are terminals of so many columns."""
    output, errors = _PretendedTerminal(), _PretendedTerminal()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        for name, value in {"TERM": "xterm", "COLUMNS": str(columns), "LINES": "24"}.items():
            patch.setenv(name, value)
        code = run(command, [str(argument) for argument in arguments])
    return Shown(code, *(CONTROL.sub("", stream.getvalue()) for stream in (output, errors)))


class _PretendedTerminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def show_in_terminal(code: str, *, columns: int = 80) -> Shown:
    """Like `in_terminal`, for Python code."""
    return _show(["-c", code], columns, {})


def _show(arguments: Sequence[str], columns: int, env: Mapping[str, str]) -> Shown:
    inherited = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    output, errors = _Terminal(columns), _Terminal(columns)
    finished = subprocess.run(
        [sys.executable, *arguments],
        stdin=output.device,
        stdout=output.device,
        stderr=errors.device,
        env=inherited | {"TERM": "xterm"} | dict(env),
        check=False,
    )
    return Shown(finished.returncode, output.close(), errors.close())


def assert_fits(text: str, columns: int = 80) -> None:
    """No line is longer than the terminal is wide, and nothing in it was cut."""
    for line in text.splitlines():
        assert len(line) <= columns, f"{len(line)} columns: {line!r}"
    assert "…" not in text, text


class _Terminal:
    """One pseudo-terminal, read as the command writes, so that a full buffer never stops it."""

    def __init__(self, columns: int) -> None:
        self._driver, self.device = pty.openpty()
        fcntl.ioctl(self.device, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        self._found: list[bytes] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        while True:
            try:
                found = os.read(self._driver, 65536)
            except OSError:  # Linux reports EIO after the last writer has closed the terminal
                return
            if not found:
                return
            self._found.append(found)

    def close(self) -> str:
        os.close(self.device)
        self._reader.join()
        os.close(self._driver)
        text = b"".join(self._found).decode().replace("\r\n", "\n")
        return CONTROL.sub("", text)
