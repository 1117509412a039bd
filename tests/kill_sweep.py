"""Builds that are killed at random until they complete: `python -m tests.kill_sweep --kills 200`.

Every build is compared with one that nobody killed: same ids, same root, no staging after gc, no orphans.
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
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tcmrl_data import Dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.disk import STAGING, lock_file, remove_abandoned

MARK = "TCMRL_KILL_SWEEP"
ORPHAN_SECONDS = 60.0
"""A worker that still lives so long after its driver is an orphan."""


@dataclass
class Figures:
    """Counts of a sweep; all but the first four must be zero."""

    kills: int = 0
    driver_kills: int = 0
    worker_kills: int = 0
    builds: int = 0
    parts_lost: int = 0
    parts_duplicated: int = 0
    findings: int = 0
    roots_that_differ: int = 0
    staging_left: int = 0
    orphans: int = 0


def command(out: Path, arguments: Sequence[str]) -> list[str]:
    """A build of point-robot-wind in a separate process."""
    start = "from tcmrl_cli.data import main; main()"
    options = ["--profile", "quick", "--workers", "2", "--out", str(out), "--quiet"]
    return [sys.executable, "-c", start, "build", "point-robot-wind", *options, *arguments]


def marked(mark: str) -> list[int]:
    """Processes that carry the mark in their environment, the oldest first."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                if f"{MARK}={mark}".encode() in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
            except OSError:
                continue  # it ended, or belongs to another user
    return sorted(found)


def kill_once(
    process: "subprocess.Popen[bytes]", mark: str, seconds: float, figures: Figures, dice: random.Random
) -> None:
    """Waits, kills the driver, a worker or all of them, and counts processes that outlive the driver.

    If a worker is to be killed, the waiting time starts when the first worker runs.
    """
    what = dice.choice(["driver", "worker", "all"])
    while what != "driver" and process.poll() is None and len(marked(mark)) < 2:
        time.sleep(0.02)
    try:
        process.wait(timeout=seconds)
        return
    except subprocess.TimeoutExpired:
        pass
    workers = [pid for pid in marked(mark) if pid != process.pid]
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
    while marked(mark) and time.monotonic() < deadline:
        time.sleep(0.02)
    for orphan in marked(mark):
        figures.orphans += 1
        os.kill(orphan, signal.SIGKILL)


def build_under_fire(
    out: Path, arguments: Sequence[str], figures: Figures, dice: random.Random, *, kills: int, pause: float
) -> Dataset:
    """Builds a dataset to its end, killing until the sweep has its number of kills."""
    mark = uuid.uuid4().hex
    while True:
        with subprocess.Popen(command(out, arguments), env=os.environ | {MARK: mark}) as process:
            while process.poll() is None:
                if figures.kills < kills:
                    kill_once(process, mark, dice.uniform(0.2, pause), figures, dice)
                else:
                    process.wait()
        if process.returncode == 0:
            return open_dataset(out)


def compare(dataset: Dataset, reference: Dataset, figures: Figures) -> None:
    """Adds to the figures what differs from the reference."""
    out, expected = dataset.folder, {entry.key: entry.id for entry in reference.parts.entries()}
    found = {entry.key: entry.id for entry in dataset.parts.entries()}
    figures.builds += 1
    figures.parts_lost += sum(not dataset.file_of(key).is_file() for key in expected)
    figures.parts_lost += sum(found.get(key) != part for key, part in expected.items())
    figures.parts_duplicated += len(list(out.rglob("*.zip"))) - len(expected)
    figures.parts_duplicated += dataset.manifest.parts.lines - 1 - len(expected)
    figures.roots_that_differ += dataset.manifest.root != reference.manifest.root
    figures.findings += len(verify_dataset(out).findings)
    with lock_file(out / ".lock", "dataset"):
        remove_abandoned(out)
    figures.staging_left += len(list((out / STAGING).iterdir()))


def run_sweep(kills: int, *, pause: float, seed: int, arguments: Sequence[str]) -> Figures:
    """Kills builds until `kills` processes have died; every build is then run to its end."""
    figures, dice = Figures(), random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        reference = Path(folder) / "reference"
        subprocess.run(command(reference, arguments), check=True)
        while figures.kills < kills:
            out = Path(folder) / "killed"
            dataset = build_under_fire(out, arguments, figures, dice, kills=kills, pause=pause)
            compare(dataset, open_dataset(reference), figures)
            shutil.rmtree(out)
    return figures


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
    figures = run_sweep(options.kills, pause=options.pause, seed=options.seed, arguments=options.arguments)
    print(json.dumps(asdict(figures) | {"seconds": round(time.monotonic() - started)}))  # noqa: T201


if __name__ == "__main__":
    main()
