"""Every command that a page prints is one that the programs take, and every block says what it is."""

import ast
import re
import shlex
import tomllib
from collections.abc import Iterator
from itertools import dropwhile
from pathlib import Path

import click
import pytest

from tcmrl_data.foundation.errors import UnknownNameError
from tests.page_blocks import PAGES, PROGRAMS, blocks, command_words, commands
from tests.workers import ROOT

LANGUAGES = {"bash", "console", "python", "toml", "json", "text", "bibtex"}
PROSE_COMMAND = re.compile(r"`((?:tcmrl-data|tcmrl) [^`]*)`")
TARGET = re.compile(r"^([a-z-]+):", re.MULTILINE)


@pytest.mark.parametrize("page", PAGES)
def test_every_block_names_its_language_and_is_of_it(page: str) -> None:
    for block in blocks(page):
        if block.language.startswith("{"):
            continue  # a directive of the site
        assert block.language in LANGUAGES, f"{block.place}: {block.language!r}"
        if block.language == "python":
            ast.parse(block.text)
        if block.language == "toml":
            tomllib.loads(block.text)


@pytest.mark.parametrize("page", PAGES)
def test_every_printed_command_parses(page: str) -> None:
    for block in blocks(page):
        for command in commands(block):
            try:
                check(command.words)
            except UnknownNameError:
                assert page.startswith("examples/")  # whose plug-ins are not installed here
            except (click.ClickException, AssertionError) as error:
                pytest.fail(f"{block.place}: {' '.join(command.words)}: {error}")


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_name_options_that_exist(page: str) -> None:
    text = re.sub(
        r"^```.*?^```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    for found in PROSE_COMMAND.findall(text):
        program, *words = found.split()
        command, rest = command_of(PROGRAMS[program], words)
        known = {
            option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)
        }
        options = {word.partition("=")[0] for word in rest if word.startswith("--")} - {"--help"}
        assert options <= known, f"{page}: `{found}`"


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_example_of_a_help_text_parses(program: str) -> None:
    examples = list(examples_of(PROGRAMS[program]))
    assert len(examples) > 10
    for words in examples:
        try:
            check(words)
        except (click.ClickException, AssertionError) as error:
            pytest.fail(f"{' '.join(words)}: {error}")


def examples_of(command: click.Command) -> Iterator[tuple[str, ...]]:
    """The command lines in the help texts of a command and of those below it."""
    for line in (command.help or "").splitlines():
        if line.strip().startswith(tuple(f"{program} " for program in PROGRAMS)):
            yield command_words(shlex.split(line, comments=True))
    for found in getattr(command, "commands", {}).values():
        yield from examples_of(found)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("tcmrl-data", "bild", "point-robot"), "No such command"),
        (("tcmrl-data", "build", "point-robot", "--folder", "x"), "No such option"),
        (("tcmrl-data", "derive"), "Missing argument"),
        (("tcmrl", "train", "data/demo", "--stop-at", "many"), "not a valid integer"),
        (("make", "deom"), "deom"),
        (("python", "benchmarks/absent.py"), "absent"),
    ],
)
def test_a_command_that_no_program_takes_is_found(words: tuple[str, ...], problem: str) -> None:
    with pytest.raises((click.ClickException, AssertionError)) as found:
        check(words)
    error = found.value
    assert problem in (error.format_message() if isinstance(error, click.ClickException) else str(error))


def check(words: tuple[str, ...]) -> None:
    """Parses a command line of a program of ours, or looks for the files and targets that it names.

    Raises:
        ClickException: the program does not take it.
        AssertionError: it names a target or a file that is not there.
    """
    program, *rest = dropwhile(re.compile("[A-Z_]+=").match, words)  # without variables of the environment
    if program in PROGRAMS:
        parse(PROGRAMS[program], rest)
    elif program == "make":
        targets = set(TARGET.findall((ROOT / "Makefile").read_text(encoding="utf-8")))
        missing = {word for word in rest if "=" not in word} - targets
        assert not missing, missing
    elif program in ("python", "pytest"):
        modules = [word.replace(".", "/") + ".py" for word in rest if word.startswith("tests.")]
        files = [*modules, *(word.partition("::")[0] for word in rest if word.endswith(".py"))]
        missing = {file for file in files if not (ROOT / file).is_file()}
        assert not missing, missing
    elif program == "source":
        assert rest == [".venv/bin/activate"], rest  # which `make demo` made
    else:
        assert Path(program).name in ("pip", "mkdir"), program


def parse(command: click.Command, words: list[str]) -> None:
    """Parses options and arguments as the program does, without running anything."""
    context = command.make_context(command.name, list(words))
    while isinstance(command, click.Group):
        rest = [*context._protected_args, *context.args]
        name, found, rest = command.resolve_command(context, rest)
        assert found is not None, name
        command, context = found, found.make_context(name, rest, parent=context)


def command_of(command: click.Command, words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that words lead to, and the words behind it."""
    while isinstance(command, click.Group) and words and words[0] in command.commands:
        command, words = command.commands[words[0]], words[1:]
    return command, words
