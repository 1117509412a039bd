"""Pages: escaped texts, figures as JSON and as pictures, and the policy in the head."""

import base64
import hashlib
import html
import importlib.util
import json
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tcmrl_data.page import interactive
from tcmrl_data.page.figures import Axis, Cells, Figure, Frame, Series
from tcmrl_data.page.interactive import figure_document
from tcmrl_data.page.markup import Markup, cell_text, details, element, escape, table
from tcmrl_data.page.page import MISSING_PLOTLY, Page
from tcmrl_data.page.still import PANELS, figure_picture, shown_frames

HOSTILE = "_</script> $\\frac{$ <img src=x onerror=alert(1)> & \"quoted\" 'single' %{x}"

needs_plotly = pytest.mark.skipif(
    importlib.util.find_spec("plotly") is None, reason="plotly is not installed: pip install 'tcmrl[report]'"
)


def figure(frames: int = 1, text: str = "name", **changes: Any) -> Figure:
    made = tuple(
        Frame(
            f"{text} {number}",
            (
                Series(None, np.array([1.0, number]), text, markers=True),
                Series(np.array([0.0, 1.0]), np.array([2.0, np.nan]), text, bars=True),
            ),
            Cells(np.eye(3, dtype=np.uint16) * (number + 1), text, is_count=True),
        )
        for number in range(frames)
    )
    values = {"x": Axis(text, -1.0, 1.0), "y": Axis(text, ticks={0.0: text}), "slider": text}
    return Figure("example", text, frames=made, **(values | changes))


def documents(page: str) -> list[dict[str, Any]]:
    """The JSON documents of a page's figures."""
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page)]


def test_texts_are_escaped_wherever_they_stand() -> None:
    made = element("p", HOSTILE, element("b", "1 < 2"), title=HOSTILE, hidden=True, lang=None)
    assert made.count("<") == 4
    assert html.unescape(made[made.index(">") + 1 : made.index("<b>")]) == HOSTILE
    assert made.startswith('<p title="_&lt;/script&gt;')
    assert " hidden" in made
    assert "lang" not in made
    assert "<img" not in table([HOSTILE], [[HOSTILE]], text=[HOSTILE]) + details(HOSTILE, HOSTILE)


def test_characters_that_html_forbids_are_replaced() -> None:
    assert escape("a\x00b\x1b[1m\ud800c\n") == "a\ufffdb\ufffd[1m\ufffdc\n"
    assert escape("a\ud800").encode() == "a\ufffd".encode()


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, "–"),
        (True, "yes"),
        (12345, "12,345"),
        (0.123456, "0.1235"),
        (-12345.6, "-12,346"),
        (float("nan"), "nan"),
        ("<", "<"),
    ],
)
def test_cells_are_short(value: object, expected: str) -> None:
    assert cell_text(value) == expected


def test_void_elements_have_no_end() -> None:
    assert element("img", src="a", alt="") == '<img src="a" alt="">'
    assert element("p", Markup("<br>")) == "<p><br></p>"


@needs_plotly
def test_no_text_of_a_figure_leaves_its_script() -> None:
    page = Page(HOSTILE)
    page.section("one", HOSTILE)
    page.figure(figure(2, HOSTILE))
    text = page.html()
    assert "<img" not in text
    assert text.count("</script>") == 3  # data, plotly.js, the page's own
    (document,) = documents(text)
    assert document["frames"][1]["label"] == f"{HOSTILE} 1"
    trace = document["frames"][0]["traces"][1]
    assert html.unescape(trace["name"]) == HOSTILE  # plotly.js reads tags, and decodes these
    assert "<" not in json.dumps(document["layout"]) + trace["hovertemplate"].replace("<extra>", "").replace(
        "</extra>", ""
    )
    assert "%{" not in trace["hovertemplate"].split("<extra>")[1]


@needs_plotly
def test_the_policy_allows_the_pages_scripts_alone() -> None:
    page = Page("title")
    page.section("one", "One")
    page.figure(figure())
    text = page.html()
    policy = html.unescape(re.findall(r'Content-Security-Policy" content="(.*?)"', text)[0])
    scripts = re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert len(digests) == 2
    assert f"script-src 'sha256-{digests[0]}' 'sha256-{digests[1]}'; " in policy
    assert policy.startswith("default-src 'none'; ")
    markup = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r'(?:src|href)="(?!#|data:)', markup)


def test_a_page_without_figures_runs_no_script() -> None:
    page = Page("title")
    page.section("one", "One", element("p", "text"))
    page.picture(b"\x89PNG", "a picture")
    text = page.html()
    assert "<script" not in text
    assert "script-src 'none'" in html.unescape(text)
    assert 'src="data:image/png;base64,iVBORw=="' in text


def test_arrays_come_back_as_they_were() -> None:
    document = figure_document(figure(2))
    cells, line, bars = document["frames"][1]["traces"]
    assert (cells["z"]["dtype"], cells["z"]["shape"], cells["isCount"]) == ("u2", "3, 3", True)
    assert (cells["x0"], cells["dx"]) == (pytest.approx(-2 / 3), pytest.approx(2 / 3))
    assert "x" not in line
    assert np.frombuffer(base64.b64decode(line["y"]["bdata"]), "<f8").tolist() == [1.0, 1.0]
    assert (bars["type"], line["mode"]) == ("bar", "lines+markers")
    integers = interactive._numbers(np.array([2**40, -1]))
    assert np.frombuffer(base64.b64decode(integers["bdata"]), "<f8").tolist() == [2.0**40, -1.0]


def test_rows_share_the_horizontal_axis() -> None:
    made = figure(below=(Axis("second"), Axis("third")))
    layout = figure_document(made)["layout"]
    domains = [layout[name]["domain"] for name in ("yaxis", "yaxis2", "yaxis3")]
    assert domains[0][1] == 1.0
    assert domains[2][0] == pytest.approx(0.0)
    assert all(upper[0] > lower[1] for upper, lower in pairwise(domains))
    assert layout["xaxis"]["anchor"] == "y3"


@pytest.mark.check
@pytest.mark.parametrize("text", ["name", HOSTILE])
def test_pictures_are_the_same_every_time_and_take_any_text(text: str) -> None:
    made = figure(2, text)
    picture = figure_picture(made)
    assert picture == figure_picture(made)
    assert base64.b64decode(picture.partition(",")[2]).startswith(b"<?xml")


@pytest.mark.check
def test_a_picture_shows_some_frames_and_says_so() -> None:
    assert [frame.label for frame in shown_frames(figure(50))][:: PANELS - 1] == ["name 0", "name 49"]
    page = Page("title", is_interactive=False)
    page.section("one", "One")
    page.figure(figure(50))
    assert "6 of 50 are drawn." in page.html()
    assert "<script" not in page.html()
    rows = figure(3, below=(Axis("second"),), start=2)
    assert [frame.label for frame in shown_frames(rows)] == ["name 2"]
    assert figure_picture(rows)


def test_without_plotly_pages_have_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tcmrl_data.page.page.plotly_script", lambda: None)
    assert not Page("title").is_interactive
    assert "tcmrl[report]" in MISSING_PLOTLY
