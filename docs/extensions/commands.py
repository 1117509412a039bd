"""The directive `commands`: all commands of a program, as `--help` describes them."""

import re
from collections.abc import Iterator
from importlib import import_module

import click
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

CODE = re.compile(r"`([^`]+)`")


def setup(app: Sphinx) -> ExtensionMetadata:
    """Adds the directive."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class Commands(Directive):
    """Sections for a program's commands; the argument is `module:name` of its click group."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The program's own help, and a section per command."""
        module, _, name = self.arguments[0].partition(":")
        program = getattr(import_module(module), name)
        context = click.Context(program, info_name=program.name, **program.context_settings)
        sections = [section(command, context) for command in subcommands(program)]
        return [*description(program, context), *sections]


def subcommands(group: click.Command) -> list[click.Command]:
    """The commands of a group by name; none of a command that is no group."""
    return sorted(getattr(group, "commands", {}).values(), key=lambda command: command.name or "")


def section(command: click.Command, parent: click.Context) -> nodes.section:
    """The section of a command, with sections of its own commands."""
    context = click.Context(command, info_name=command.name, parent=parent)
    made = nodes.section(ids=[nodes.make_id(context.command_path)], names=[context.command_path])
    made += nodes.title(text=context.command_path)
    made += description(command, context)
    made += [section(each, context) for each in subcommands(command)]
    return made


def description(command: click.Command, context: click.Context) -> Iterator[nodes.Node]:
    """Usage, help and options of a command."""
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    yield nodes.literal_block(usage, usage, language="text", classes=["usage"])
    for paragraph in re.split(r"\n\s*\n", command.help or ""):
        yield from block(paragraph)
    described = (parameter.get_help_record(context) for parameter in command.get_params(context))
    records = [record for record in described if record and record[1]]
    if records:
        yield options(records)


def block(paragraph: str) -> Iterator[nodes.Node]:
    """A paragraph of a help text; lines that click is told to keep become code."""
    lines = paragraph.strip().splitlines()
    if not lines or lines[0].strip() != "\b":
        yield inline(nodes.paragraph(), " ".join(line.strip() for line in lines))
        return
    kept = [line.rstrip() for line in lines[1:]]
    if kept and kept[0].endswith(":"):
        yield nodes.paragraph(text=kept.pop(0))
    text = "\n".join(line.strip() for line in kept)
    yield nodes.literal_block(text, text, language="bash")


def options(records: list[tuple[str, str]]) -> nodes.Node:
    """The options as a list of definitions."""
    made = nodes.definition_list(classes=["options"])
    for names, text in records:
        term = nodes.term()
        term += nodes.literal(text=names)
        definition = nodes.definition()
        definition += inline(nodes.paragraph(), text)
        made += nodes.definition_list_item("", term, definition)
    return made


def inline(node: nodes.TextElement, text: str) -> nodes.TextElement:
    """A node with text, in which backquotes mark code."""
    for position, piece in enumerate(CODE.split(text)):
        if piece:
            node += nodes.literal(text=piece) if position % 2 else nodes.Text(piece)
    return node
