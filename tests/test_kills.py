"""Commands that are killed at random lose nothing, double nothing, and leave nobody behind."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from random import Random

import pytest

from tcmrl_data import open_dataset, verify_dataset
from tcmrl_data.store.manifest import MANIFEST
from tests.conftest import TINY
from tests.kill_sweep import Figures, build, run_sweep
from tests.killed_commands import cases

COMMANDS = ("derive", "cut", "merge", "extend", "extend to a new dataset", "import")


def expect_nothing_lost(figures: Figures, kills: int) -> None:
    counted = ("kills", "driver_kills", "worker_kills", "finished")
    assert figures.kills >= kills
    assert {name: value for name, value in asdict(figures).items() if name not in counted and value} == {}


ARGUMENTS = ["--tasks", "0,5,12,15,20,30", *(word for override in TINY for word in ("--set", override))]


@pytest.mark.check
def test_a_killed_build_loses_nothing() -> None:
    expect_nothing_lost(run_sweep(build(ARGUMENTS, pause=5.0), 1, seed=0), 1)


@pytest.mark.sweep
def test_killed_builds_lose_nothing_and_leave_nobody_behind() -> None:
    """Twenty kills; `python -m tests.kill_sweep` does two hundred on the quick profile itself."""
    figures = run_sweep(build(ARGUMENTS, pause=5.0), 20, seed=0)
    expect_nothing_lost(figures, 20)
    assert min(figures.driver_kills, figures.worker_kills, figures.finished) > 0


@pytest.mark.check
@pytest.mark.parametrize("command", ["derive", "merge", "extend", "import"])
def test_a_killed_command_loses_nothing(command: str, tiny_folder: Path, tmp_path: Path) -> None:
    """One kill; the next test does fifty of every command."""
    expect_nothing_lost(run_sweep(cases(tmp_path, tiny_folder)[command], 1, seed=0), 1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("command", COMMANDS)
def test_fifty_kills_of_a_command_lose_nothing(command: str, tiny_folder: Path, tmp_path: Path) -> None:
    """`python -m tests.killed_commands` prints the figures."""
    expect_nothing_lost(run_sweep(cases(tmp_path, tiny_folder)[command], 50, seed=0), 50)


RECORDING = """
import sys
from tests.test_recording import go_on
print("ready", flush=True)
go_on(sys.argv[1], int(sys.argv[2]), lambda episodes: print(episodes, flush=True))
"""


@pytest.mark.check
def test_a_killed_recording_loses_the_open_episode_alone(tmp_path: Path, sweep: int) -> None:
    """A recorder that is killed goes on behind the last episode whose end it has told."""
    from tests.test_recording import go_on

    episodes, wanted = 60, 50 if sweep == 1 else 3
    go_on(tmp_path / "whole", episodes)
    dice, kills, runs = Random(0), 0, 0
    while kills < wanted:
        runs += 1
        out, told = tmp_path / f"killed-{runs}", 0
        while not (out / MANIFEST).exists():
            arguments = [sys.executable, "-c", RECORDING, str(out), str(episodes)]
            with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                assert process.stdout.readline() == "ready\n"
                if kills < wanted:
                    time.sleep(dice.uniform(0.0, 0.3))
                    os.kill(process.pid, signal.SIGKILL)
                lines = process.stdout.read().split("\n")[:-1]
            assert process.returncode in (0, -signal.SIGKILL)
            kills += process.returncode == -signal.SIGKILL
            if lines:
                assert int(lines[0]) >= told
                told = int(lines[-1])
        assert open_dataset(out).manifest.root == open_dataset(tmp_path / "whole").manifest.root
        assert verify_dataset(out, level="deep").findings == ()
