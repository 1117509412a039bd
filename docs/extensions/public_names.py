"""The directive `public-names`: reference pages of the names in a package's `__init__.pyi`, by room."""

import ast
import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.nodes import nested_parse_with_titles
from sphinx.util.typing import ExtensionMetadata


def setup(app: Sphinx) -> ExtensionMetadata:
    """Adds the directive."""
    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class PublicNames(Directive):
    """Sections by room, with an entry of autodoc for every public name; the argument is the package."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The sections."""
        made = nodes.section()
        made.document = self.state.document
        lines = StringList(list(entries(self.arguments[0])), source=self.arguments[0])
        nested_parse_with_titles(self.state, lines, made)
        return made.children


def entries(package: str) -> Iterator[str]:
    """The text of a page with all public names of a package."""
    module = import_module(package)
    rooms: dict[str, list[tuple[str, str]]] = {}
    for node in ast.parse(Path(str(module.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            room = node.module.partition(".")[0]
            source = f"{package}.{node.module}"
            rooms.setdefault(room, []).extend((alias.name, source) for alias in node.names)
    for room, names in rooms.items():
        title = room.replace("_", " ").capitalize()
        yield from (title, "-" * len(title), "")
        for name, source in names:
            yield from entry(package, name, source, getattr(module, name))


def entry(package: str, name: str, source: str, public: object) -> Iterator[str]:
    """The directive for a public name.

    Args:
        package: that the name is imported from.
        name: the public name.
        source: the module that defines it.
        public: the object.
    """
    if inspect.isclass(public) or inspect.isroutine(public):
        kind = "function" if inspect.isroutine(public) else "class"
        yield from (f".. auto{kind}:: {package}.{name}", "   :members:" if kind == "class" else "", "")
        return
    documented = ModuleAnalyzer.for_module(source).find_attr_docs()
    yield from (f".. py:data:: {package}.{name}", "")
    yield from (f"   {line}" for line in documented.get(("", name), []))
