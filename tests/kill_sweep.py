"""Commands that are killed at random and given again until they end.

What they make is compared with what they make when nobody kills them: same ids, same root, no staging after
gc, no orphans. `python -m tests.kill_sweep --kills 200` kills builds, `python -m tests.killed_commands` the
other commands.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tcmrl_data import Dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.disk import STAGING, lock_file, remove_abandoned
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.tables import PARTS
from tests.workers import MARK, marked_pids

ORPHAN_SECONDS = 60.0
"""A worker that still lives so long after its driver is an orphan."""

START = """
import tcmrl_data.building.build, tcmrl_data.operations.extend, tcmrl_data.interchange.importing
from tcmrl_cli.data import main
print("ready", flush=True)
main()
"""
"""Kills are counted from `ready` on, when Python and the modules are loaded."""


@dataclass
class Figures:
    """Counts of a sweep; all but the first four must be zero."""

    kills: int = 0
    driver_kills: int = 0
    worker_kills: int = 0
    finished: int = 0
    parts_lost: int = 0
    parts_duplicated: int = 0
    findings: int = 0
    roots_that_differ: int = 0
    staging_left: int = 0
    orphans: int = 0


@dataclass(frozen=True)
class Case:
    """A command of `tcmrl-data` that makes or changes a dataset.

    Attributes:
        arguments: of the command, by the dataset's folder.
        parts: number of parts of the dataset; a kill waits until a random number of them is there.
        pause: longest time that it waits then, in seconds.
        has_workers: whether the command starts processes, which are killed too.
        begin: makes what is in the folder before the command.
        most_kills: of one dataset, which is left to end after a random number of them.
    """

    arguments: Callable[[Path], Sequence[object]]
    parts: int
    pause: float
    has_workers: bool = False
    begin: Callable[[Path], object] = lambda out: None
    most_kills: int = 4


def start(case: Case, out: Path, errors: int, mark: str) -> "subprocess.Popen[bytes]":
    """The command in a process of its own, which has loaded its modules."""
    arguments = [sys.executable, "-c", START, *map(str, case.arguments(out)), "--quiet"]
    process = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=errors, env=os.environ | {MARK: mark}, cwd=Path.cwd()
    )
    assert process.stdout is not None
    process.stdout.readline()
    return process


def kill_once(
    process: "subprocess.Popen[bytes]",
    case: Case,
    out: Path,
    mark: str,
    figures: Figures,
    dice: random.Random,
) -> None:
    """Waits, kills the driver, a worker or all of them, and counts processes that outlive the driver.

    If a worker is to be killed, the waiting time starts when the first worker runs.
    """
    what = dice.choice(["driver", "worker", "all"]) if case.has_workers else "driver"
    wanted, seconds = dice.randint(0, case.parts), dice.uniform(0.0, case.pause)
    while process.poll() is None and (
        len(list((out / PARTS).rglob("*.zip"))) < wanted or (what != "driver" and len(marked_pids(mark)) < 2)
    ):
        time.sleep(0.002)
    try:
        process.wait(timeout=seconds)
        return
    except subprocess.TimeoutExpired:
        pass
    workers = [pid for pid in sorted(marked_pids(mark)) if pid != process.pid]
    victims = {"driver": [process.pid], "worker": workers[:1], "all": [process.pid, *workers]}[what]
    for pid in victims:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
        figures.kills += 1
        figures.driver_kills += pid == process.pid
        figures.worker_kills += pid != process.pid
    if process.pid not in victims:
        return
    process.wait()
    deadline = time.monotonic() + ORPHAN_SECONDS
    while marked_pids(mark) and time.monotonic() < deadline:
        time.sleep(0.02)
    for orphan in marked_pids(mark):
        figures.orphans += 1
        os.kill(orphan, signal.SIGKILL)


def finish_under_fire(case: Case, out: Path, figures: Figures, dice: random.Random, *, kills: int) -> Dataset:
    """Gives a command again and again until it ends, killing until the sweep has its number of kills.

    Raises:
        RuntimeError: the command fails although nothing was killed.
    """
    mark = uuid.uuid4().hex
    while True:
        killed = figures.kills
        with tempfile.TemporaryFile() as errors:
            with start(case, out, errors.fileno(), mark) as process:
                while process.poll() is None:
                    if figures.kills < kills:
                        kill_once(process, case, out, mark, figures, dice)
                    else:
                        process.wait()
            errors.seek(0)
            said = errors.read().decode()
        if (out / MANIFEST).exists():
            figures.findings += sum(not finding.foreign for finding in verify_dataset(out).findings)
        # a dataset that was whole before the kill is refused as one that exists
        if process.returncode == 0 or (process.returncode == 2 and "exists and is not empty" in said):
            return open_dataset(out)
        if figures.kills == killed:
            raise RuntimeError(f"exit code {process.returncode}: {said}")


def compare(dataset: Dataset, reference: Dataset, figures: Figures) -> None:
    """Adds to the figures what differs from the reference."""
    out, expected = dataset.folder, {entry.key: entry.id for entry in reference.parts.entries()}
    found = {entry.key: entry.id for entry in dataset.parts.entries()}
    figures.finished += 1
    figures.parts_lost += sum(not dataset.file_of(key).is_file() for key in expected)
    figures.parts_lost += sum(found.get(key) != part for key, part in expected.items())
    figures.parts_duplicated += len(list(out.rglob("*.zip"))) - len(expected)
    figures.parts_duplicated += dataset.manifest.parts.lines - 1 - len(expected)
    figures.roots_that_differ += dataset.manifest.root != reference.manifest.root
    figures.findings += len(verify_dataset(out).findings)
    with lock_file(out / ".lock", "dataset"):
        remove_abandoned(out)
    figures.staging_left += len(list((out / STAGING).iterdir()))


def run_sweep(case: Case, kills: int, *, seed: int) -> Figures:
    """Kills a command until `kills` processes have died; every one is then left to end."""
    figures, dice = Figures(), random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        reference, out = Path(folder) / "reference", Path(folder) / "killed"
        case.begin(reference)
        made = finish_under_fire(case, reference, figures, dice, kills=0)
        while figures.kills < kills:
            case.begin(out)
            wanted = min(kills, figures.kills + dice.randint(1, case.most_kills))
            compare(finish_under_fire(case, out, figures, dice, kills=wanted), made, figures)
            shutil.rmtree(out)
    return figures


def build(arguments: Sequence[str], *, pause: float) -> Case:
    """A build of point-robot-wind; a kill comes at any time."""
    options = ["build", "point-robot-wind", "--profile", "quick", "--workers", "2", *arguments]
    return Case(lambda out: [*options, "--out", out], 0, pause, has_workers=True, most_kills=40)


def main() -> None:
    """Parses, sweeps, prints JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument(
        "--pause", type=float, default=30.0, help="longest time between two kills, in seconds"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("arguments", nargs="*", help="further arguments of `tcmrl-data build`, after --")
    options = parser.parse_args()
    started = time.monotonic()
    figures = run_sweep(build(options.arguments, pause=options.pause), options.kills, seed=options.seed)
    print(json.dumps(asdict(figures) | {"seconds": round(time.monotonic() - started)}))  # noqa: T201


if __name__ == "__main__":
    main()
