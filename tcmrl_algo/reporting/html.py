"""A report as one HTML file, with its figures in it: the paragraphs, tables and figures of the Markdown."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from markupsafe import Markup

from tcmrl_algo.reporting.compose import Page, Picture
from tcmrl_algo.reporting.tables import Table
from tcmrl_data.page.page import escaped, render_page

_HEADING = re.compile(r"(#+) (.*)")
_INLINE = re.compile(r"`([^`]+)`|\[([^\]]+)\]\(([^()\s]+)\)")


def page_html(page: Page) -> str:
    """The content of `report.html`; the page's figures are read from its folder.

    Raises:
        OSError: a figure was not drawn.
    """
    title = str(page.blocks[0]).lstrip("# ")
    blocks = list(_blocks(page))
    first = next((place for place, block in enumerate(blocks) if block["kind"] == "section"), len(blocks))
    values = {"above": blocks[:first], "blocks": blocks[first:]}
    return render_page("report.html.jinja", Path(__file__).parent, title=title, values=values)


def _blocks(page: Page) -> Iterator[dict[str, Any]]:
    """What the template shows below the title, with the kind of each block."""
    for block in page.blocks[1:]:
        heading = _HEADING.fullmatch(block) if isinstance(block, str) else None
        if isinstance(block, Picture):
            yield {
                "kind": "picture",
                "content": (page.out / block.file).read_bytes(),
                "caption": block.caption,
            }
        elif isinstance(block, Table):
            cells = zip(*block.rows, strict=True) if block.rows else [()] * len(block.columns)
            text = [
                name
                for name, column in zip(block.columns, cells, strict=True)
                if any(isinstance(cell, str) for cell in column)
            ]
            yield {"kind": "table", "columns": block.columns, "rows": block.rows, "text": text}
        elif heading is None:
            yield {"kind": "text", "text": _inline(block)}
        elif heading[1] == "##":
            yield {"kind": "section", "heading": heading[2].replace("`", "")}
        else:
            yield {"kind": f"h{len(heading[1])}", "text": _inline(heading[2])}


def _inline(text: str) -> Markup:
    """A paragraph's text, in which code and links to files beside the report become elements."""
    return Markup(_INLINE.sub(_element, escaped(text)))


def _element(match: "re.Match[str]") -> str:
    code, words, file = match.groups()
    if code is not None:
        return f"<code>{code}</code>"
    return f'<a href="{file}">{words}</a>' if Path(file).name == file else words
