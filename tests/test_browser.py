"""Reports in a real browser: figures are drawn, sliders move, nothing is asked of the network."""

from collections.abc import Iterator
from pathlib import Path

import pytest

import tcmrl_data
from tcmrl_algo.report.write import page_html
from tests.chromium import Chromium, chromium_or_skip, running_chromium
from tests.experiments import made_report

HOSTILE = (
    "<script>document.title='taken'</script><img src=https://example.com/x onerror=document.title='taken'>"
)

pytestmark = pytest.mark.check

OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    with running_chromium(chromium_or_skip()) as running:
        yield running


@pytest.fixture(scope="module")
def hostile_copy(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A view of the tiny dataset under a name that would like to be markup."""
    folder = tmp_path_factory.mktemp("hostile") / "dataset"
    tcmrl_data.derive_dataset(tcmrl_data.open_dataset(tiny_folder), folder, label=HOSTILE)
    return folder


def assert_quiet(browser: Chromium) -> None:
    """No error and no warning on the console, no request, and no horizontal overflow at any width."""
    for width in (400, 1600):
        browser.resize(width)
        browser.wait(f"{OVERFLOW} <= 0")
    assert (browser.problems, browser.requests) == ([], [])


def test_a_datasets_report(browser: Chromium, hostile_copy: Path, tmp_path: Path) -> None:
    pytest.importorskip("plotly", reason="plotly is not installed: pip install 'tcmrl[report]'")
    file = tmp_path / "report.html"
    tcmrl_data.report_dataset(tcmrl_data.open_dataset(hostile_copy), file)
    browser.open(file)
    figures = browser.evaluate("document.querySelectorAll('figure').length")
    drawn = "Array.from(document.querySelectorAll('figure')).filter(f => f.querySelector({}))"
    marks = "'.scatterlayer path.js-line, .barlayer path, .heatmaplayer image'"
    assert browser.evaluate(f"{drawn.format(marks)}.length") == figures >= 6
    paths = "Array.from(layer.querySelectorAll('path'), path => path.getBBox().height)"
    heights = browser.evaluate(f"Array.from(document.querySelectorAll('.barlayer'), layer => {paths})")
    assert len([bar for bar in heights if bar]) == 2  # returns and rewards
    assert all(max(found) > 20 for found in heights if found)  # pixels
    assert browser.evaluate("document.title") == f"{HOSTILE}: what is in the dataset"
    assert browser.evaluate("document.images.length") == 0
    sliders = browser.evaluate("Array.from(document.querySelectorAll('.slider input'), i => i.id)")
    assert len(sliders) >= 5
    for slider in sliders:
        assert_moves(browser, slider)
    assert_quiet(browser)
    assert browser.paper().startswith(b"%PDF")
    browser.print_preview()
    browser.wait(f"{OVERFLOW} <= 0")
    assert browser.problems == []


def assert_moves(browser: Chromium, slider: str) -> None:
    """Every move of a slider draws another picture under another label."""
    seen = set()
    last = browser.evaluate(f"Number(document.getElementById('{slider}').max)")
    for place in (0, last):
        seen.add(
            browser.evaluate(
                f"""(async () => {{
                    const slider = document.getElementById('{slider}');
                    const figure = slider.closest('figure');
                    const plot = figure.querySelector('.plot');
                    slider.value = {place};
                    const drawn = new Promise((resolve) => plot.once('plotly_afterplot', resolve));
                    slider.dispatchEvent(new Event('input'));
                    await drawn;
                    const picture = Array.from(plot.querySelectorAll('path, image'),
                        (e) => e.getAttribute('d') || e.getAttribute('href')).join();
                    return figure.querySelector('output').textContent + '|' + picture;
                }})()"""
            )
        )
    labels = {text.partition("|")[0] for text in seen}
    pictures = {text.partition("|")[2] for text in seen}
    assert (len(labels), len(pictures)) == (2, 2), slider


def test_a_report_of_results(browser: Chromium, tmp_path: Path) -> None:
    page = made_report(tmp_path)
    file = tmp_path / "report.html"
    file.write_text(page_html(page), encoding="utf-8")
    browser.open(file)
    assert browser.evaluate("document.images.length") == len(page.figures) >= 2
    assert browser.evaluate("Array.from(document.images).every(image => image.naturalWidth > 0)")
    assert_quiet(browser)
    browser.print_preview()
    browser.wait(f"{OVERFLOW} <= 0")


def test_the_browser_sees_what_it_should(browser: Chromium, tmp_path: Path) -> None:
    """The checks above can fail: this page runs a script, asks for pictures, and is too wide."""
    file = tmp_path / "bad.html"
    file.write_text(
        "<script>console.error('seen')</script><img src='http://example.com/x.png'>"
        "<div style='width:5000px'>wide</div>"
    )
    browser.open(file)
    browser.wait("document.images[0].complete")
    assert browser.evaluate(OVERFLOW) > 0
    assert browser.requests == ["http://example.com/x.png"]
    assert any("seen" in problem for problem in browser.problems)
    browser.problems.clear()
    browser.requests.clear()
