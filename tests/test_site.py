"""The documentation as a site: it builds without a warning, is complete, and a dead link fails the build."""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import click
import pytest

from tests.page_blocks import PROGRAMS
from tests.workers import PATIENCE, ROOT

pytest.importorskip("sphinx", reason="needs the extra `docs`")

pytestmark = pytest.mark.check  # imports everything, and takes 15 seconds of one core


def build(docs: Path, out: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    """What `make docs` does."""
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "--builder",
        "html",
        "--fail-on-warning",
        "--keep-going",
        "--quiet",
    ]
    return subprocess.run(
        [*command, *options, str(docs), str(out)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site") / "docs"
    done = build(ROOT / "docs", out)
    assert done.returncode == 0, done.stderr
    return out


def test_every_command_and_option_has_its_place(site: Path) -> None:
    for program, command in PROGRAMS.items():
        page = unescape((site / "reference" / f"{program}.html").read_text(encoding="utf-8"))
        for path, found in walk(program, command):
            assert f'id="{path.replace(" ", "-")}"' in page, path
            options = {option for parameter in found.params for option in parameter.opts if option[0] == "-"}
            assert {option for option in options if option not in page} == set(), path


def walk(path: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """The commands below a group, with the words that call them."""
    for name, found in getattr(command, "commands", {}).items():
        yield f"{path} {name}", found
        yield from walk(f"{path} {name}", found)


@pytest.mark.parametrize("package", ["tcmrl_data", "tcmrl_algo"])
def test_every_public_name_has_its_place(site: Path, package: str) -> None:
    page = (site / "reference" / f"{package}.html").read_text(encoding="utf-8")
    stub = ast.parse((ROOT / package / "__init__.pyi").read_text(encoding="utf-8"))
    names = {alias.name for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert len(names) > 50
    assert {name for name in names if f'id="{package}.{name}"' not in page} == set()


def test_the_site_asks_nothing_of_other_sites(site: Path) -> None:
    """Links may lead elsewhere; scripts, styles, fonts and pictures may not."""
    loaded = re.compile(
        r'<(?:script|img|source|iframe)[^>]* src="(?:https?:)?//|<link[^>]* href="(?:https?:)?//'
    )
    assert [
        page.name for page in site.rglob("*.html") if loaded.search(page.read_text(encoding="utf-8"))
    ] == []


def test_dead_links_fail_the_build(tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    shutil.copytree(ROOT / "docs" / "extensions", docs / "extensions")
    shutil.copytree(ROOT / "docs" / "static", docs / "static")
    shutil.copy(ROOT / "docs" / "conf.py", docs)
    (tmp_path / "README.md").write_text("# Front\n\n[sound](docs/page.md#there), [dead](docs/absent.md)\n")
    (docs / "index.md").write_text("[README](../README.md)\n\n```{toctree}\npage\n```\n")
    (docs / "page.md").write_text(
        "# Page\n\n## There\n\n[sound](../README.md#front), [dead](#nowhere), [dead](index.md#nothing)\n\n"
        "![dead](no.png)\n"
    )
    done = build(docs, tmp_path / "out")
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if "WARNING" in line]
    for dead in ("absent.md", "nowhere", "nothing", "no.png"):
        assert sum(dead in line for line in lines) == 1, (dead, lines)
    assert len(lines) == 4, lines
