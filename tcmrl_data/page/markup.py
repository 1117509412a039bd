"""Elements of HTML in which every text is escaped, so that no name of a dataset becomes markup."""

import html
from collections.abc import Iterable, Sequence
from typing import Any

VOID = frozenset({"br", "img", "input", "meta"})
"""Elements without an end tag."""

LONG_TEXT = 60
"""Characters from which a text in a table is broken into lines."""

Cell = str | float | int | None


class Markup(str):
    """Text that is HTML already; any other string is escaped where it becomes part of an element."""

    __slots__ = ()


def escape(text: str) -> Markup:
    """A text as HTML; characters that HTML forbids are replaced by question marks."""
    allowed = "".join(
        character if _is_allowed(character) else "\N{REPLACEMENT CHARACTER}" for character in text
    )
    return Markup(html.escape(allowed, quote=True))


def element(tag: str, *children: str, **attributes: str | int | bool | None) -> Markup:
    """An element.

    Args:
        tag: its name.
        children: markup, or texts to be escaped.
        attributes: names as in HTML, `kind` for `class` and `_` for `-`; None and False leave one out.
    """
    words = [tag]
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        name = "class" if name == "kind" else name.replace("_", "-")
        words.append(name if value is True else f'{name}="{escape(str(value))}"')
    start = f"<{' '.join(words)}>"
    return Markup(start if tag in VOID else f"{start}{join(children)}</{tag}>")


def join(children: Iterable[str]) -> Markup:
    """Children behind one another; texts that are not markup are escaped."""
    return Markup("".join(child if isinstance(child, Markup) else escape(child) for child in children))


def table(
    columns: Sequence[str], rows: Iterable[Sequence[Cell | Markup]], *, text: Iterable[str] = ()
) -> Markup:
    """A table that scrolls sideways where it is wider than the page.

    Args:
        columns: headings.
        rows: cells; None is a missing value, a float is shown with four significant digits.
        text: columns that hold text, aligned left; all others are aligned right.
    """
    kinds = ["text" if column in set(text) else None for column in columns]
    head = [
        element("th", column, kind=kind, scope="col") for column, kind in zip(columns, kinds, strict=True)
    ]
    body = [
        element("tr", *(_cell(cell, kind) for cell, kind in zip(row, kinds, strict=True))) for row in rows
    ]
    inner = element("thead", element("tr", *head)), element("tbody", *body)
    return element("div", element("table", *inner), kind="scroll", tabindex=0)


def _cell(cell: Cell | Markup, kind: str | None) -> Markup:
    text = cell_text(cell)
    return element("td", text, kind=f"{kind} long" if kind and len(text) > LONG_TEXT else kind)


def details(summary: str, *children: str) -> Markup:
    """Content that is folded until the reader opens it; pages on paper show it."""
    return element("details", element("summary", summary), *children)


def cell_text(cell: Any) -> str:
    """A value as text: four significant digits of a float, separators in an integer, a dash for None."""
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, int):
        return f"{cell:,}"
    if isinstance(cell, float):
        return f"{cell:,.0f}" if abs(cell) >= 10_000 else f"{cell:.4g}"
    return cell if isinstance(cell, str) else str(cell)


def _is_allowed(character: str) -> bool:
    """Whether HTML allows a character: no control characters but white space, and no surrogates."""
    code = ord(character)
    return character in "\t\n\r" or (code >= 0x20 and not 0x7F <= code < 0xA0 and not 0xD800 <= code < 0xE000)
