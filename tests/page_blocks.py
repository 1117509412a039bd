"""Code blocks of the documentation's pages: language, commands, and the marks in front of them."""

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile

import click
from tcmrl_cli.data import data
from tcmrl_cli.train import tcmrl

from tests.workers import ROOT

PROGRAMS: dict[str, click.Command] = {"tcmrl-data": data, "tcmrl": tcmrl}
PAGES = sorted(
    str(page.relative_to(ROOT))
    for page in (
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("examples/*/*.md"),
        ROOT / "results/README.md",
    )
)
MARKS = ("not run", "tested with", "exit code", "file")

_MARK = re.compile(rf"<!-- (?P<kind>{'|'.join(MARKS)}):? (?P<text>.*?) -->")
_COMMENT = re.compile(r"\s*<!--.*-->\s*")


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        place: page and line.
        language: the word behind the fence; empty where there is none.
        marks: kind to text of the comments right before the block.
    """

    place: str
    language: str
    text: str
    marks: dict[str, str]


@dataclass(frozen=True)
class Command:
    """A command line, split into words, and what the page shows of its output."""

    words: tuple[str, ...]
    shown: tuple[str, ...] = ()


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page, in order."""
    found: list[Block] = []
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    opened: int | None = None
    marks: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        if line.startswith("```") and opened is None:
            opened = number
        elif line == "```" and opened is not None:
            text = "\n".join(lines[opened : number - 1])
            found.append(Block(f"{page}:{opened}", lines[opened - 1][3:], text, marks))
            opened, marks = None, {}
        elif opened is None:
            marks = marks | dict(_MARK.findall(line)) if _COMMENT.fullmatch(line) else {}
    assert opened is None, f"{page}:{opened} is not closed"
    return found


def commands(block: Block) -> list[Command]:
    """The commands of a block of `bash`, or of the lines with a prompt in one of `console`."""
    if block.language == "bash":
        joined = block.text.replace("\\\n", " ")
        return [Command(words) for line in joined.splitlines() for words in _split(line)]
    if block.language != "console":
        return []
    found: list[Command] = []
    for piece in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        line, *shown = piece.splitlines()
        *first, last = _split(line)
        found += [*map(Command, first), Command(last, tuple(shown))]
    return found


def _split(line: str) -> Iterator[tuple[str, ...]]:
    """The commands of a line, which `&&` joins, without redirections of their output."""
    words: list[str] = []
    for word in [*shlex.split(line, comments=True), "&&"]:
        if word == "&&" and words:
            yield command_words(words)
            words = []
        elif word != "&&":
            words.append(word)


def command_words(words: Sequence[str]) -> tuple[str, ...]:
    """The words of a command up to a redirection."""
    return tuple(takewhile(lambda word: not word.startswith(">"), words))
