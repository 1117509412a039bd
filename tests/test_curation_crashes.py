"""Derivations and unions whose file operations fail, whose power is cut, or that are killed."""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tcmrl_data import Dataset, TcmrlError, derive_dataset, merge_datasets, open_dataset, verify_dataset
from tcmrl_data.build.work_files import ASSEMBLY
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.disk import STAGING, remove_abandoned
from tcmrl_data.store.manifest import MANIFEST
from tests.graded import graded_dataset
from tests.simulated_disk import FAULTS, LOSSES, Fault, FaultyDisk, Operation, PowerCut, RecordingDisk

Command = Callable[[list[Path], Path], object]
COMMANDS: dict[str, Command] = {
    "derive": lambda sources, out: derive_dataset(sources[0], out, tier="medium-replay"),
    "cut": lambda sources, out: derive_dataset(sources[0], out, tasks=[0], episodes=2, tier="medium-expert"),
    "merge": lambda sources, out: merge_datasets(sources, out),
}


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder in memory if the system has one, because thousands of syncs on a disk are slow."""
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if os.access(shared, os.W_OK) else None) as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("sources")
    scores = {0: 0.0, 100: 40.0, 200: 90.0}
    return [graded_dataset(folder / f"{seed}", seed=seed, scores=scores).folder for seed in range(2)]


def expect_whole(command: Command, sources: list[Path], out: Path, expected: Dataset, place: str) -> None:
    """Checks that the same command, given again, ends with each part of the reference once."""
    if not (out / MANIFEST).exists() or (out / ASSEMBLY).exists():
        command(sources, out)
    made = open_dataset(out)
    assert made.manifest.digest == expected.manifest.digest, place
    found = sorted(file.relative_to(out) for file in out.rglob("*.zip"))
    assert found == sorted(file.relative_to(expected.folder) for file in expected.folder.rglob("*.zip")), (
        place
    )
    assert verify_dataset(out).findings == (), place
    remove_abandoned(out)
    assert list((out / STAGING).iterdir()) == [], place


def logged(command: Command, sources: list[Path], out: Path) -> list[Operation]:
    """All file operations of a command."""
    out.parent.mkdir()
    recorder = RecordingDisk()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publish, "disk", recorder)
        command(sources, out)
    return recorder.log


def run_with_fault(command: Command, sources: list[Path], out: Path, at: int, fault: Fault) -> int:
    """Runs a command in a forked process whose disk fails at one operation; its exit status."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 3
    try:
        publish.disk = FaultyDisk(at, fault)
        command(sources, out)
        status = 0
    except TcmrlError:
        status = 1
    finally:
        os._exit(status)


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_the_same_command_recovers_from_a_fault_at_any_operation(
    sources: list[Path], memory: Path, name: str, fault: Fault, sweep: int
) -> None:
    command = COMMANDS[name]
    operations = len(logged(command, sources, memory / "whole" / "data"))
    expected = open_dataset(memory / "whole" / "data")
    stride = max(1, sweep // 4)
    for at in range(FAULTS.index(fault) % stride, operations, stride):
        out = memory / f"{at}" / "data"
        out.parent.mkdir()
        status = run_with_fault(command, sources, out, at, fault)
        place = f"operation {at} of {operations}"
        assert status == (-9 if fault in ("kill", "torn") else 1), place
        expect_whole(command, sources, out, expected, place)
        shutil.rmtree(out.parent)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_power_cut_leaves_no_dataset_or_a_whole_one(
    sources: list[Path], memory: Path, name: str, sweep: int
) -> None:
    command, root = COMMANDS[name], memory / "whole"
    log = logged(command, sources, root / "data")
    expected, disk, work = open_dataset(root / "data"), PowerCut(root), memory / "cut"
    for index, operation in enumerate(log):
        disk.apply(operation)
        if index % max(1, sweep // 4) and index != len(log) - 1:
            continue
        for loss in LOSSES:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir()
            disk.leave(work, loss)
            place = f"after operation {index} of {len(log)}, {loss} lost"
            if (work / "data" / MANIFEST).exists():
                assert verify_dataset(work / "data").findings == (), place
            else:
                assert index < len(log) - 1, place
            expect_whole(command, sources, work / "data", expected, place)


CHILD = """
import sys
from pathlib import Path
from tests.test_curation_crashes import COMMANDS
sources = [Path(name) for name in sys.argv[2:-1]]
print("ready", flush=True)
COMMANDS[sys.argv[1]](sources, Path(sys.argv[-1]))
"""


@pytest.mark.sweep
def test_killed_commands_lose_nothing(sources: list[Path], tmp_path: Path) -> None:
    dice, kills = random.Random(0), 0
    for name, command in COMMANDS.items():
        command(sources, tmp_path / name)
    while kills < 50:
        name = dice.choice(list(COMMANDS))
        out = tmp_path / "killed"
        arguments = [sys.executable, "-c", CHILD, name, *map(str, sources), str(out)]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(dice.uniform(0, 0.3))
            process.send_signal(signal.SIGKILL)
        kills += process.returncode == -signal.SIGKILL
        expect_whole(COMMANDS[name], sources, out, open_dataset(tmp_path / name), name)
        shutil.rmtree(out)
