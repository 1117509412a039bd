"""A page in one file that needs no network: sections, tables and figures in one frame.

A policy in the page's head lets the browser run the page's own scripts alone, known by their digests, and
load nothing from anywhere.
"""

import base64
import hashlib
import importlib.resources
import json
from typing import final

from tcmrl_data.page.figures import Figure
from tcmrl_data.page.interactive import figure_document, plotly_script
from tcmrl_data.page.markup import Markup, element
from tcmrl_data.page.still import figure_picture, shown_frames

MISSING_PLOTLY = (
    "Figures are pictures, because plotly is not installed: pip install 'tcmrl[report]' for sliders."
)


@final
class Page:
    """A page to which sections are added from top to bottom.

    Args:
        title: of the page.
        is_interactive: draw figures with plotly.js, if it is installed.

    Attributes:
        is_interactive: whether figures are drawn with plotly.js.

    Example:
        >>> page = Page("A <b>bold</b> name")
        >>> page.add(element("p", "1 < 2"))
        >>> "<p>1 &lt; 2</p>" in page.html()
        True
    """

    def __init__(self, title: str, *, is_interactive: bool = True) -> None:
        self.title = title
        self.is_interactive = is_interactive and plotly_script() is not None
        self._head: list[str] = []
        self._body: list[str] = []
        self._sections: dict[str, str] = {}
        self._figures: set[str] = set()

    def add(self, *content: str) -> None:
        """Adds elements; before the first section they stand above the contents."""
        (self._body if self._sections else self._head).extend(content)

    def section(self, name: str, heading: str, *content: str) -> None:
        """Begins a section.

        Args:
            name: unique; the fragment of its address.
            heading: its heading.
            content: its first elements.
        """
        assert name not in self._sections, name
        self._sections[name] = heading
        self._body += [element("h2", heading, id=name), *content]

    def figure(self, figure: Figure) -> None:
        """Adds a figure."""
        assert figure.name not in self._figures, figure.name
        self._figures.add(figure.name)
        self.add(_interactive(figure) if self.is_interactive else _still(figure))

    def picture(self, content: bytes, caption: str, *, kind: str = "image/png") -> None:
        """Adds a picture, given the bytes of its file."""
        source = f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
        image = element("img", src=source, alt=caption)
        self.add(element("figure", image, element("figcaption", caption), kind="picture"))

    def html(self) -> str:
        """The whole page."""
        scripts = (
            [plotly_script() or "", _resource("page.js")] if self.is_interactive and self._figures else []
        )
        links = [element("a", heading, href=f"#{name}") for name, heading in self._sections.items()]
        head = (
            element("meta", charset="utf-8"),
            element("meta", http_equiv="Content-Security-Policy", content=_policy(scripts)),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("title", self.title),
            element("style", Markup(_resource("page.css"))),
        )
        body = (
            element("h1", self.title),
            *self._head,
            element("nav", *links) if links else "",
            element("main", *self._body),
            *(element("script", Markup(script)) for script in scripts),
        )
        page = element("html", element("head", *head), element("body", *body), lang="en")
        return f"<!doctype html>\n{page}\n"


def _interactive(figure: Figure) -> Markup:
    document = json.dumps(figure_document(figure), allow_nan=False, separators=(",", ":"))
    # `</script>` in a text would end the element; in JSON these characters stand in strings only.
    safe = document.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    content = [
        element("div", kind="plot", style=f"height:{figure.height}px", role="img", aria_label=figure.caption),
        element("script", Markup(safe), type="application/json"),
        element("noscript", "This figure is drawn by the page's own script, which the browser did not run."),
    ]
    if len(figure.frames) > 1:
        content.insert(0, _slider(figure))
    return element(
        "figure", *content, element("figcaption", figure.caption), kind="interactive", id=figure.name
    )


def _slider(figure: Figure) -> Markup:
    last, identifier = len(figure.frames) - 1, f"{figure.name}-slider"
    control = element(
        "input", type="range", id=identifier, min=0, max=last, value=figure.start, step=1, autocomplete="off"
    )
    output = element("output", figure.frames[figure.start].label, **{"for": identifier})
    return element(
        "div", element("label", figure.slider, **{"for": identifier}), control, output, kind="slider"
    )


def _still(figure: Figure) -> Markup:
    caption = figure.caption
    shown = len(shown_frames(figure))
    if shown < len(figure.frames):
        caption += f" {shown} of {len(figure.frames)} are drawn."
    image = element("img", src=figure_picture(figure), alt=figure.caption)
    return element("figure", image, element("figcaption", caption), kind="picture", id=figure.name)


def _policy(scripts: list[str]) -> str:
    digests = [
        base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii") for script in scripts
    ]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:"


def _resource(name: str) -> str:
    return (importlib.resources.files("tcmrl_data.page") / name).read_text(encoding="utf-8")
