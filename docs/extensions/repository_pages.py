"""Pages made of files of the repository, and links that hold both on GitHub and on the site.

Links in Markdown files are relative to the file, as GitHub wants them. Before Sphinx reads a page, those that
leave the folder of the documentation are pointed at the page that shows their target.
"""

import os
import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

# What is code holds no links.
LINK = re.compile(r"(?P<code>^```.*?^```|`[^`\n]*`)|\]\((?P<target>[^)\s]+)\)", re.DOTALL | re.MULTILINE)


def setup(app: Sphinx) -> ExtensionMetadata:
    """Adds the settings `repository_pages` and `repository_links`."""
    app.add_config_value("repository_pages", {}, "env", dict)
    app.add_config_value("repository_links", {}, "env", dict)
    app.connect("source-read", read_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def read_page(app: Sphinx, page: str, source: list[str]) -> None:
    """Puts the repository's file in front of the page's own text, and repairs links of both."""
    if Path(app.env.doc2path(page)).suffix != ".md":
        return
    docs = Path(app.srcdir)
    own = docs / f"{page}.md"
    text = with_links(app, source[0], written_in=own.parent, shown_in=own.parent)
    if page in app.config.repository_pages:
        file = docs.parent / app.config.repository_pages[page]
        app.env.note_dependency(str(file))
        shown = with_links(app, file.read_text(encoding="utf-8"), written_in=file.parent, shown_in=own.parent)
        text = shown + "\n" + text.partition("\n\n")[2]
    source[0] = text


def with_links(app: Sphinx, text: str, *, written_in: Path, shown_in: Path) -> str:
    """A text with its relative links as they must be in another folder.

    Args:
        app: has the settings.
        text: Markdown.
        written_in: folder of the file that the text stands in.
        shown_in: folder of the page that shows it.
    """
    root = Path(app.srcdir).parent
    pages = {file: f"{page}.md" for page, file in app.config.repository_pages.items()}
    pages |= app.config.repository_links

    def moved(match: re.Match[str]) -> str:
        path, mark, anchor = (match["target"] or "").partition("#")
        if not path or ":" in path:
            return match[0]
        target = Path(os.path.normpath(written_in / path))
        inside = os.path.relpath(target, root)
        holder = next((place for place in (inside, os.path.dirname(inside)) if place in pages), None)
        if holder is not None:
            target = Path(app.srcdir) / pages[holder]
        return f"]({os.path.relpath(target, shown_in)}{mark}{anchor})"

    return LINK.sub(moved, text)
