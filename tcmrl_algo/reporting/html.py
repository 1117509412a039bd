"""A report as one HTML file, with its figures in it: the paragraphs, tables and figures of the Markdown."""

import re
from collections.abc import Iterable
from pathlib import Path

from tcmrl_algo.reporting.compose import Block, Page, Picture
from tcmrl_algo.reporting.tables import Table
from tcmrl_data.page.markup import Markup, element, join, table
from tcmrl_data.page.page import Page as HtmlPage

_HEADING = re.compile(r"(#+) (.*)")
_INLINE = re.compile(r"`([^`]+)`|\[([^\]]+)\]\(([^()\s]+)\)")


def page_html(page: Page) -> str:
    """The content of `report.html`; the page's figures are read from its folder.

    Raises:
        OSError: a figure was not drawn.
    """
    title, *blocks = page.blocks
    made = HtmlPage(str(title).lstrip("# "), is_interactive=False)
    sections = 0
    for block in blocks:
        heading = _HEADING.fullmatch(block) if isinstance(block, str) else None
        if heading is not None and heading[1] == "##":
            sections += 1
            made.section(f"section-{sections}", heading[2].replace("`", ""))
        elif heading is not None:
            made.add(element(f"h{len(heading[1])}", *_inline(heading[2])))
        elif isinstance(block, Picture):
            made.picture((page.out / block.file).read_bytes(), block.caption)
        else:
            made.add(_block(block))
    return made.html()


def _block(block: Block) -> Markup:
    if isinstance(block, Table):
        text = [
            column
            for place, column in enumerate(block.columns)
            if any(isinstance(row[place], str) for row in block.rows)
        ]
        return table(block.columns, block.rows, text=text)
    assert isinstance(block, str)
    return element("p", *_inline(block))


def _inline(text: str) -> Iterable[str]:
    """A paragraph's text, in which code and links to files beside the report become elements."""
    place = 0
    for match in _INLINE.finditer(text):
        yield text[place : match.start()]
        code, words, file = match.groups()
        is_beside = file is not None and Path(file).name == file
        if code is not None:
            yield element("code", code)
        else:
            yield element("a", words, href=file) if is_beside else join([words])
        place = match.end()
    yield text[place:]
