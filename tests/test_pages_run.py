"""The pages' commands and Python blocks run as printed, page by page, on the dataset of the tour."""

import fcntl
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from tests.commands import in_process
from tests.page_blocks import PAGES, PROGRAMS, Block, Command, blocks, commands

FIRST_MET = ("README.md", "docs/tour.md")
"""What a newcomer meets, and `make check` runs; all other pages are sweeps."""

RUNNABLE = ("bash", "console", "python")
TO_RUN = [
    page
    for page in PAGES
    if any(block.language in RUNNABLE and "not run" not in block.marks for block in blocks(page))
    and not page.startswith("CONTRIBUTING")  # commands of the repository
]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset that the tour builds, by its command; built once for all processes of a session."""
    session = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        session = session.parent
    folder = session / "demo"
    with (session / "demo.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "data" / "demo" / "manifest.json").exists():
            folder.mkdir(exist_ok=True)
            (build,) = (
                command.words
                for block in blocks("docs/tour.md")
                for command in commands(block)
                if command.words[1] == "build"
            )
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(folder)
                PROGRAMS[build[0]].main(list(build[1:]), standalone_mode=False)
    return folder / "data" / "demo"


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.check if page in FIRST_MET else pytest.mark.sweep)
        for page in TO_RUN
    ],
)
def test_a_page_runs_as_printed(
    page: str, demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(demo, tmp_path / "data" / "demo")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        if "not run" in block.marks:
            continue
        if "file" in block.marks:
            (tmp_path / block.marks["file"]).write_text(block.text + "\n", encoding="utf-8")
        if block.language == "python":
            exec(compile(block.text, block.place, "exec"), namespace)
        for command in commands(block):
            if command.words[0] in PROGRAMS:
                run(command, block, capsys)
            elif command.words[0] == "mkdir":
                subprocess.run(command.words, check=True)
    plt.close("all")


def run(command: Command, block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs a command; its exit code and the words that the page shows of its output must be right."""
    program, *words = command.words
    options = shlex.split(block.marks.get("tested with", ""))
    code, output, errors = in_process(PROGRAMS[program], capsys)(*words, *options)
    assert code == int(block.marks.get("exit code", 0)), (
        f"{block.place}: {' '.join(command.words)}: {errors}{output[-2000:]}"
    )
    printed = set(map(simplified, output.splitlines()))
    for line in map(simplified, command.shown):
        assert line in printed or re.search(r"\d|…", line), f"{block.place}: {line!r} is not printed"


def simplified(line: str) -> str:
    """A line without what depends on the width of columns."""
    return re.sub("─+", "─", " ".join(line.split()))
