"""Progress on standard error, and how durations and sizes are written."""

import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest
from tcmrl_cli.frame import duration, size
from tcmrl_cli.progress import StageProgress

from tests.conftest import TINY

BUILD = ("build", "point-robot", "--profile", "quick")
MAIN = "from tcmrl_cli.data import main; main()"
SETTINGS = [argument for text in TINY for argument in ("--set", text)]


def test_plain_progress_goes_to_standard_error(tmp_path: Path) -> None:
    result = subprocess.run(
        [
            sys.executable,
            "-c",
            MAIN,
            *BUILD,
            *SETTINGS,
            "--tasks",
            "0",
            "--out",
            str(tmp_path / "d"),
            "--json",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(result.stdout)["built"] == 3
    lines = result.stderr.strip().splitlines()
    assert lines[-1].startswith("published parts: 3 of 3 parts, ")
    assert not any("\x1b" in line for line in lines)


def test_a_terminal_gets_bars() -> None:
    code = (
        "from tcmrl_cli.progress import StageProgress\n"
        "with StageProgress() as progress:\n"
        "    progress.update('training', done=5, total=10, unit='steps')\n"
        "    progress.note('half of it')\n"
        "    progress.update('training', done=10, total=10, unit='steps')\n"
    )
    driver, terminal = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    subprocess.run([sys.executable, "-c", code], stderr=terminal, check=True, env=environment)
    os.close(terminal)
    shown = os.read(driver, 65536).decode()
    os.close(driver)
    assert "training" in shown
    assert "10/10 steps" in shown
    assert "half of it" in shown
    assert "━" in shown


def test_quiet_progress_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with StageProgress(quiet=True) as progress:
        progress.update("training", done=10, total=10, unit="steps")
        progress.note("something")
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.96, "10.0 s"),
        (42, "42 s"),
        (60, "1 min 0 s"),
        (3_725, "1 h 2 min"),
        (200_000, "2 d 7 h"),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(("num_bytes", "text"), [(999, "999 B"), (1_500, "1.5 kB"), (2.5e12, "2.5 TB")])
def test_sizes(num_bytes: float, text: str) -> None:
    assert size(num_bytes) == text
