"""Ctrl-C and SIGTERM: a checkpoint, one line that says how to continue, and no traceback."""

import re
import shlex
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tcmrl_cli.train import tcmrl

from tcmrl_algo import open_run, resume_run, train_run
from tcmrl_algo.training.train import TrainingProgress
from tcmrl_data import Dataset
from tests.commands import Call, assert_refused
from tests.small_training import SMALL, config_of
from tests.workers import PATIENCE, command_line, wait_for

PROGRAM = tcmrl

SETTINGS = [argument for text in SMALL for argument in ("--set", text)]


@pytest.fixture
def as_in_a_program() -> Any:
    """Ctrl-C raises KeyboardInterrupt and SIGHUP ends, even if the tests run by nohup."""
    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)
    hanging_up = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, earlier)
    signal.signal(signal.SIGHUP, hanging_up)


def interrupt_at(step: int) -> Callable[[TrainingProgress], None]:
    def report(progress: TrainingProgress) -> None:
        if progress.step == step:
            signal.raise_signal(signal.SIGINT)

    return report


@pytest.mark.check
@pytest.mark.usefixtures("as_in_a_program")
def test_an_interrupted_run_saves_its_step_and_ends_in_the_same_tensors(
    tiny: Dataset, tmp_path: Path
) -> None:
    config = config_of(tiny)
    straight = train_run(tiny, tmp_path / "straight", config=config, profile="quick", steps=60)
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        train_run(tiny, folder, config=config, profile="quick", steps=60, report=interrupt_at(30))
    assert [checkpoint.step for checkpoint in open_run(folder).checkpoints()] == [25, 30]
    said: list[str] = []
    assert resume_run(folder, tiny, say=said.append).digest == straight.digest
    assert said == ["going on from step 30"]


@pytest.mark.check
def test_slurms_warning_saves_a_checkpoint_and_the_run_goes_on(tiny: Dataset, tmp_path: Path) -> None:
    config = config_of(tiny)

    def warn(progress: TrainingProgress) -> None:
        if progress.step == 30:
            signal.raise_signal(signal.SIGUSR1)

    report = train_run(tiny, tmp_path, config=config, profile="quick", steps=40, report=warn)
    assert [checkpoint.step for checkpoint in open_run(tmp_path).checkpoints()] == [30, 40]  # not [25, 40]
    straight = train_run(tiny, tmp_path / "straight", config=config, profile="quick", steps=40)
    assert report.digest == straight.digest


@pytest.mark.check
def test_a_run_killed_before_its_first_checkpoint_says_that_it_begins_anew(
    tiny: Dataset, tmp_path: Path
) -> None:
    class Killed(BaseException):
        """No error of a method's code, after which nothing is left: the process ends."""

    def kill(progress: TrainingProgress) -> None:
        raise Killed

    with pytest.raises(Killed):
        train_run(tiny, tmp_path / "run", config=config_of(tiny), profile="quick", steps=20, report=kill)
    said: list[str] = []
    resume_run(tmp_path / "run", tiny, say=said.append)
    assert said == ["no checkpoint was saved: starting at step 0"]


@pytest.mark.check
@pytest.mark.usefixtures("as_in_a_program")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_command_that_an_interrupted_training_prints_goes_on(
    tiny_folder: Path, tmp_path: Path, call: Call, number: signal.Signals
) -> None:
    folder = tmp_path / "run"
    typed = ("train", str(tiny_folder), *SETTINGS, "--set", "run.steps=200000", "--out", str(folder))
    with command_line(*typed, program="tcmrl") as process:
        wait_for(lambda: _logged(folder), "training")
        for _ in range(4):
            process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE)
    step = open_run(folder).newest().step
    line = errors.strip().splitlines()[-1]
    assert (process.returncode, output) == (1, "")
    assert "Traceback" not in errors
    assert line.startswith(f"Error: interrupted; to continue from step {step:,}, run `tcmrl train ")
    again = shlex.split(re.search("`(.*)`", line)[1])[1:]  # type: ignore[index]
    assert again == [*typed, "--resume"]
    code, _, errors = call(*again, "--stop-at", step + 5)
    assert (code, f"going on from step {step:,}" in errors) == (0, True)
    assert open_run(folder).newest().step == step + 5


@pytest.mark.check
def test_a_build_interrupted_until_it_ends_gives_one_line_and_exit_code_1(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    with command_line("build", "point-robot", "--workers", "1", "--out", str(folder)) as process:
        wait_for((folder / "manifest.json").is_file, "the build's first manifest")
        time.sleep(0.5)
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(0.02)
        output, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, output) == (1, "")
    assert "Traceback" not in errors
    assert (
        errors.strip().splitlines()[-1].startswith(f"Error: interrupted; finished work is kept in {folder}")
    )


def _logged(folder: Path) -> bool:
    return (folder / "metrics.jsonl").is_file() and bool((folder / "metrics.jsonl").read_text())


@pytest.mark.check
def test_resuming_takes_the_settings_of_the_run_and_no_others(
    tiny: Dataset, tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    folder = tmp_path / "run"
    train_run(tiny, folder, config=config_of(tiny), profile="quick", steps=5)
    again = ("train", tiny_folder, "--out", folder, "--stop-at", 10)
    assert_refused(call(*again), "--resume")
    gone = ("train", tmp_path / "gone", "--resume", "--out", folder)
    assert_refused(call(*gone), "gone", "present folder of the run's dataset")
    refused = call(*again, "--resume", "--set", SMALL[0], "--set", "tcmrl.latent=5")
    assert_refused(refused, "tcmrl.latent=5", "omit it")
    assert_refused(call(*again, "--resume", "--profile", "paper"), "--profile quick")
    assert call(*again, "--resume", *SETTINGS, "--profile", "quick")[0] == 0
    assert open_run(folder).newest().step == 10
