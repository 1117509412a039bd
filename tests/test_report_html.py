"""`report.html` of results: what the Markdown says, in one file, with every text escaped."""

import html
import re
from pathlib import Path

from tcmrl_algo.reporting.compose import Page, Picture, compose
from tcmrl_algo.reporting.html import page_html
from tcmrl_algo.reporting.tables import Table
from tcmrl_algo.reporting.write import measure_paths, page_text
from tests.experiments import made_report

HOSTILE = "<img src=x onerror=alert(1)>"


def test_the_page_says_what_the_markdown_says(tmp_path: Path) -> None:
    folder = made_report(tmp_path)
    page, _ = compose(measure_paths([folder]), folder)
    made = page_html(page)
    text = html.unescape(re.sub(r"<[^>]+>", "", made))
    for line in page_text(page).splitlines():
        if line.startswith("|") and "---" not in line:
            cells = [cell.strip().replace("\\|", "|") for cell in line.strip("|").split(" | ")]
            assert "".join(cells).replace(",", "") in text.replace(",", ""), line
        elif line.startswith("#"):
            assert line.lstrip("# ").replace("`", "") in text
    assert made.count("<img ") == page_text(page).count("![") == len(page.figures) > 0
    assert made.count("data:image/png;base64,") == len(page.figures)
    assert "<script" not in made


def test_labels_of_strangers_stay_text(tmp_path: Path) -> None:
    (tmp_path / "figure.png").write_bytes(b"\x89PNG")
    page = Page(tmp_path)
    page.text("# Report")
    page.text(f"Before the first section: {HOSTILE}.")
    page.text(f"## {HOSTILE}")
    page.text(f"### `{HOSTILE}`")
    page.text(
        f"A [file](results.csv), a [trap](javascript:alert(1)), [another](https://example.com), `{HOSTILE}`."
    )
    page.table(Table("table", (HOSTILE, "number"), ((HOSTILE, 0.5), (None, 12_345.0))))
    page.figure("figure", HOSTILE, None)
    assert page.blocks[-1] == Picture("figure.png", HOSTILE)
    made = page_html(page)
    assert made.count("<img ") == 1
    assert html.escape(HOSTILE) in made
    assert re.findall(r'<a href="([^"]*)"', made) == ["#section-1", "results.csv"]
    assert ">12,345</td>" in made
    assert f'<td class="text">{html.escape(HOSTILE)}</td><td>0.5</td>' in made
