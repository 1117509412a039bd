"""Runs command lines in this process, and checks the output of refused ones."""

from collections.abc import Callable

import click
import pytest
from tcmrl_cli.frame import run

Call = Callable[..., tuple[int, str, str]]
"""Arguments to exit code, standard output, standard error."""


def in_process(command: click.Command, capsys: pytest.CaptureFixture[str]) -> Call:
    """Runs a root command in this process."""

    def call(*arguments: object) -> tuple[int, str, str]:
        code = run(command, [str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def assert_refused(result: tuple[int, str, str], *expected: str) -> None:
    """Exit code 2, nothing on standard output, and one line `Error: …` that holds the expected texts."""
    code, output, errors = result
    lines = errors.strip().splitlines()
    assert (code, output) == (2, ""), errors
    assert len(lines) == 1, lines
    assert lines[0].startswith("Error: "), lines
    for text in expected:
        assert text in lines[0], lines
