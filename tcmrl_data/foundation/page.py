"""HTML pages in one file that need no network, from Jinja templates in which every text is escaped.

A policy in the page's head lets the browser run the page's own scripts alone, known by their digests, and
load nothing from anywhere.
"""

import base64
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

_FORBIDDEN = re.compile(r"[^\t\n\r\x20-\x7e\xa0-\ud7ff\ue000-\U0010ffff]")
"""Characters that HTML does not allow."""


def render_page(
    template: str, folder: Path, *, title: str, scripts: Sequence[str] = (), values: dict[str, Any]
) -> str:
    """A page.

    Args:
        template: name of a template that extends `page.html.jinja`; it may import `blocks.html.jinja`.
    """
    sections: dict[str, str] = {}

    def section(name: str, heading: str) -> Markup:
        assert name not in sections, name
        sections[name] = heading
        return Markup(f'<h2 id="{name}">{escaped(heading)}</h2>')

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, Path(__file__).parent]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_finalized,
    )
    environment.filters["cell"] = cell_text
    return environment.get_template(template).render(
        values,
        title=title,
        policy=_policy(scripts),
        scripts=[Markup(script) for script in scripts],
        section=section,
        sections=sections,
    )


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


def allowed_text(text: str) -> str:
    """The text, in which characters that HTML forbids are replaced by question marks."""
    return _FORBIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)


def escaped(text: str) -> Markup:
    """A text as HTML, without characters that HTML forbids."""
    return Markup.escape(allowed_text(text))


def _finalized(value: Any) -> Any:
    return escaped(value) if type(value) is str else value


def _policy(scripts: Sequence[str]) -> str:
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") for text in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:"
