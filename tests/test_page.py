"""Pages: escaped texts, tables, and the policy in the head."""

import base64
import hashlib
import html
import re
from pathlib import Path
from typing import Any

import pytest

from tcmrl_data.foundation.page import cell_text, render_page

HOSTILE = "_</script> $\\frac{$ <img src=x onerror=alert(1)> & \"quoted\" 'single' %{x} {{ title }}"
TEMPLATE = """{% extends "page.html.jinja" %}
{% from "blocks.html.jinja" import table %}
{% block main %}
{{ section(name, text) }}
<p title="{{ text }}">{{ text }}</p>
{{ table(columns, rows, [text]) }}
{% endblock %}
"""


def rendered(folder: Path, text: str = "text", scripts: tuple[str, ...] = (), **changes: Any) -> str:
    (folder / "test.html.jinja").write_text(TEMPLATE)
    rows = [[text, 0.123456], [None, 12_345]]
    values = {"name": "one", "text": text, "columns": [text, "number"], "rows": rows}
    return render_page("test.html.jinja", folder, title=text, scripts=scripts, values=values | changes)


def test_texts_are_escaped_wherever_they_stand(tmp_path: Path) -> None:
    page, plain = rendered(tmp_path, HOSTILE), rendered(tmp_path)
    assert re.findall(r"<[a-z/!]+", page) == re.findall(r"<[a-z/!]+", plain)
    assert html.unescape(page).count(HOSTILE) == 8
    assert "<td>0.1235</td></tr>" in page and '<tr><td class="text">–</td><td>12,345</td></tr>' in page
    assert '<td class="text long">' in page  # a long text is broken into lines


def test_characters_that_html_forbids_are_replaced(tmp_path: Path) -> None:
    page = rendered(tmp_path, "a\x00b\x1b[1m\ud800c\n")
    assert '<p title="a\ufffdb\ufffd[1m\ufffdc\n">a\ufffdb\ufffd[1m\ufffdc\n</p>' in page
    assert page.encode()


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


def test_the_policy_allows_the_pages_scripts_alone(tmp_path: Path) -> None:
    page = rendered(tmp_path, scripts=("let a = 1 < 2;\n", "b()"))
    policy = html.unescape(re.findall(r'Content-Security-Policy" content="(.*?)"', page)[0])
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert scripts == ["let a = 1 < 2;\n", "b()"]
    assert f"script-src 'sha256-{digests[0]}' 'sha256-{digests[1]}'; " in policy
    assert policy.startswith("default-src 'none'; ")
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)
    without = rendered(tmp_path)
    assert "<script" not in without and "script-src 'none'" in html.unescape(without)
