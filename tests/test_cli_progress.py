"""Progress on standard error, and the format of durations and sizes."""

import json
from pathlib import Path

import click
import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import duration, output_options
from tcmrl_cli.progress import Pace, StageProgress

from tests.commands import in_process
from tests.conftest import TINY
from tests.terminal import as_in_terminal, assert_fits, show_in_terminal

BUILD = ("build", "point-robot", "--profile", "quick")
SETTINGS = [argument for text in TINY for argument in ("--set", text)]


@pytest.mark.usefixtures("in_process")
def test_plain_progress_goes_to_standard_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (*BUILD, *SETTINGS, "--tasks", 0, "--out", tmp_path / "d", "--json")
    code, output, errors = in_process(data, capsys)(*arguments)
    assert code == 0
    assert json.loads(output)["built"] == 3
    lines = errors.strip().splitlines()
    assert lines[-1].startswith("published parts: 3 of 3 parts")
    assert not any("\x1b" in line for line in lines)


BARS = """
import time
from tcmrl_cli import progress
progress.KNOWN_SECONDS = 0.01
with progress.StageProgress() as stages:
    for done in range(0, 100_000_001, 10_000_000):
        stages.update("behavior training", done=done, total=100_000_000, unit="steps")
        stages.update("published parts", done=done / 100_000, total=1_000, unit="parts")
        time.sleep(0.02)
    stages.note("all of it")
"""


def test_bars_in_a_terminal_take_one_line_each_and_cut_no_number() -> None:
    shown = show_in_terminal(BARS)
    assert shown.code == 0
    assert_fits(shown.errors.replace("\r", "\n"))
    assert "100,000,000/100,000,000 steps" in shown.errors
    assert "1,000/1,000 parts" in shown.errors
    assert "all of it" in shown.errors
    assert "━" in shown.errors
    wrapped = [line for line in shown.errors.replace("\r", "\n").splitlines() if line and line[0] == " "]
    assert wrapped == []


def test_a_detail_is_left_out_where_it_does_not_fit() -> None:
    @click.command()
    def training() -> None:
        with StageProgress() as progress:
            progress.update("training", done=5, total=10, unit="steps", detail="45% waiting for data")

    assert "45% waiting for data" in as_in_terminal(training).errors
    narrow = as_in_terminal(training, columns=40).errors
    assert "5/10 steps" in narrow
    assert "waiting" not in narrow


def test_time_left_is_said_only_once_the_pace_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([20.0, 20.5, 22.0, 24.0, 30.0])
    monkeypatch.setattr("tcmrl_cli.progress.time.monotonic", lambda: next(clock))
    pace = Pace(0)
    found = []
    for done in (0, 1, 2, 4, 5, 11):
        pace.update(done)
        found.append(pace.seconds_left(101))
    assert found == [None, None, None, None, None, 90.0]  # one a second since the first, at 20 s
    assert pace.rate == 1.0


def test_a_long_stage_says_its_time_left_after_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([1.0, 60.0, 61.0])
    monkeypatch.setattr("tcmrl_cli.progress.time.monotonic", lambda: next(clock))
    pace = Pace(0)
    for done, expected in ((1, None), (60, None), (61, 9939.0)):
        pace.update(done)
        assert pace.seconds_left(10_000) == expected


def test_quiet_progress_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    @output_options
    def training(as_json: bool) -> None:
        with StageProgress() as progress:
            progress.update("training", done=10, total=10, unit="steps")
            progress.note("something")

    assert in_process(training, capsys)("--quiet") == (0, "", "")
    assert in_process(training, capsys)()[2] == "something\n"


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
