"""`report.html` of results: what the Markdown says, in one file, with every text escaped."""

import html
import re
from pathlib import Path

from tcmrl_algo.report.tables import Table
from tcmrl_algo.report.write import Page, page_html
from tests.experiments import made_report

HOSTILE = "<img src=x onerror=alert(1)>"


def test_the_page_says_what_the_markdown_says(tmp_path: Path) -> None:
    page = made_report(tmp_path)
    made = page_html(page)
    text = html.unescape(re.sub(r"<[^>]+>", "", made))
    words = "".join(text.split())
    for line in page.markdown().splitlines():
        if line.startswith("|") and "---" not in line:
            cells = [cell.strip().replace("\\|", "|") for cell in line.strip("|").split(" | ")]
            assert "".join("".join(cells).split()) in words, line
        elif line.startswith("#"):
            assert line.lstrip("# ").replace("`", "") in text
    assert made.count("<img ") == page.markdown().count("![") == len(page.figures) > 0
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
    page.figure("figure", HOSTILE, lambda file: None)
    assert page.blocks[-1] == f"![{HOSTILE}](figure.png)"
    made = page_html(page)
    assert made.count("<img ") == 1
    assert html.escape(HOSTILE) in made
    assert re.findall(r'<a href="([^"]*)"', made) == ["#section-1", "results.csv"]
    assert ">12,345</td>" in made
    assert re.search(
        rf'<td style="text-align:left">{re.escape(html.escape(HOSTILE))}</td>\s*<td [^>]*>0.5</td>', made
    )
