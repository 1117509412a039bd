"""Measures how long training from a bucket waits for data, beside training from a folder. Prints JSON.

`PYTHONPATH=. python benchmarks/remote_waiting.py DATASET [--steps N] [--memory-limit SIZE] [--server NAME]`

DATASET is pushed to an S3 server on the loopback, a process of its own, and `tcmrl train s3://…` runs with
an empty cache; then the same from the folder, with another empty cache. All parts of a run are fetched and
decoded before its first step: `seconds_before_first_step`, with the start of the process. An epoch is as many
steps as draw the number of the selection's transitions; shares are of the time of the steps. With
`--memory-limit 1k` the decoded steps stay in the cache's file, and are mapped.
"""

import argparse
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from _timing import Measured, rounded

import tcmrl_data
from tcmrl_data import Dataset, open_dataset
from tests.remotes import HOST, make_bucket, seaweedfs

URL = "s3://bucket/dataset"
METRICS = "metrics.jsonl"
"""The log of a run; a line has the rate since the line before, and the share of that time spent waiting."""


def main() -> None:
    """Measures both places in turn."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("dataset", type=Path)
    arguments.add_argument("--steps", type=int, default=2_000)
    arguments.add_argument("--memory-limit", default="2G")
    arguments.add_argument("--server", choices=["moto", "seaweedfs"], default="moto")
    chosen = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder, _server(chosen.server, Path(folder)) as endpoint:
        os.environ |= {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        make_bucket(endpoint, "bucket")
        tcmrl_data.push_dataset(chosen.dataset, URL)
        measured = {
            name: _train(place, Path(folder) / name, chosen.steps, chosen.memory_limit)
            for name, place in (("bucket", URL), ("folder", str(chosen.dataset)))
        }
    dataset = open_dataset(chosen.dataset)
    about = {"parts": len(dataset.parts), "bytes": dataset.manifest.totals.bytes, "server": chosen.server}
    print(json.dumps({"dataset": dataset.name, **about, **measured}, indent=1))


@contextlib.contextmanager
def _server(name: str, folder: Path) -> Iterator[str]:
    """An S3 server in a process of its own."""
    if name == "seaweedfs":
        with seaweedfs(folder) as endpoint:
            yield endpoint
        return
    with socket.socket() as found:
        found.bind((HOST, 0))
        port = found.getsockname()[1]
    command = [Path(sys.executable).with_name("moto_server"), "-H", HOST, "-p", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield f"http://{HOST}:{port}"
    finally:
        process.kill()
        process.wait()


def _train(place: str, folder: Path, steps: int, memory_limit: str) -> Measured:
    """Trains with an empty cache, and reads the run's own log of rates and waiting."""
    os.environ["TCMRL_CACHE"] = str(folder / "cache")
    run = folder / "run"
    settings = ["--set", "run.log_every=1", "--stop-at", str(steps), "--memory-limit", memory_limit]
    program = shutil.which("tcmrl", path=Path(sys.executable).parent)
    assert program is not None
    began = time.time()
    subprocess.run([program, "train", place, "--out", run, *settings, "--quiet"], check=True)
    lines = [json.loads(line) for line in (run / METRICS).read_text().splitlines()]
    epoch = _steps_of_epoch(open_dataset(place), run)
    first, rest = lines[:epoch], lines[epoch:]
    return {
        "steps_of_an_epoch": epoch,
        "epochs": rounded(len(lines) / epoch),
        "seconds_before_first_step": rounded((run / "run.json").stat().st_mtime - began),
        "waiting_in_first_epoch": _share(first),
        "waiting_after_first_epoch": _share(rest),
        "steps_per_second": rounded(len(rest) / sum(1 / line["time/steps_per_second"] for line in rest)),
    }


def _steps_of_epoch(dataset: Dataset, run: Path) -> int:
    """Steps that draw as many transitions as the training tasks have."""
    settings: dict[str, Any] = json.loads((run / "run.json").read_text())["config"]["settings"]
    selection = dataset.select(split="train", snapshots=settings["run"]["snapshots"])
    transitions = sum(dataset.entry(key).steps for keys in selection.parts.values() for key in keys)
    return -(-transitions // (settings["batch"]["tasks"] * settings["batch"]["transitions"]))


def _share(lines: list[dict[str, float]]) -> float:
    """Share of the time of logged steps that was spent waiting for batches."""
    seconds = [1 / line["time/steps_per_second"] for line in lines]
    waited = [line["time/data_share"] * time for line, time in zip(lines, seconds, strict=True)]
    return rounded(sum(waited) / sum(seconds))


if __name__ == "__main__":
    main()
