"""Measures the rate of batches against other libraries with the same work. Prints JSON, a line per size.

`python benchmarks/sampling.py [--quick] [--repeats N] [--size NAME] [--folder FOLDER]`

Sizes are 2 million transitions of half-cheetah-vel and of ml1, in random numbers (`--quick`: 1 % of them),
written to FOLDER and kept there, or to a temporary folder. Every size runs in a separate process on one
core. All contestants are measured in turns, once per repetition: a number is the median over the
repetitions, `spread` the smallest and the largest; ratios are taken within a repetition.

Kinds: `transitions` 16 tasks × 256; `trajectories` 16 whole episodes, one per task; `windows` 512 of 10
steps; `full_step` 16 × 256 transitions, 16 context and 16 execution episodes, and as many windows as the
context episodes have. Peers: see `_peers.py`; they need the extra `tcmrl[benchmark]`. A missing peer has
a reason in the place of its rates. Files are in the page cache, for ours and for peers.
"""

import argparse
import contextlib
import gc
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import _peers
import numpy as np
import torch
from _generated import generate_dataset
from _peers import Data, Draw, Work
from _timing import memory
from numcodecs.zstd import Zstd

import tcmrl_data
from tcmrl_data import Trajectories, Transitions, Windows
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import ARRAYS
from tcmrl_data.store.tables import PARTS

SIZES = {"half-cheetah-vel": (20, 10, 50), "ml1/reach": (20, 4, 50)}
"""Tasks, snapshots per task, episodes per snapshot: 2 million steps."""

QUICK = (16, 2, 2)
KINDS = ("transitions", "trajectories", "windows", "full_step")
SECONDS = 0.3
"""A measurement goes on for at least this long, and for one batch."""

COPIED_BYTES = 2**28
"""More than any cache holds."""


def main() -> None:
    """Writes the datasets, then measures every size in a separate process."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a hundredth of the data, to see that it runs")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", choices=SIZES, help="only this one")
    parser.add_argument("--folder", type=Path, help="where datasets are kept for the next run")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        with contextlib.redirect_stdout(sys.stderr):  # TorchRL logs to standard output
            result = measure(arguments.measure, arguments.repeats)
        print(json.dumps(result))
        return
    with tempfile.TemporaryDirectory(dir=".") as temporary:
        root = (arguments.folder or Path(temporary)) / ("quick" if arguments.quick else "full")
        for name in [arguments.size] if arguments.size else SIZES:
            tasks, snapshots, episodes = QUICK if arguments.quick else SIZES[name]
            folder = root / name.replace("/", "-")
            generate_dataset(folder, name, tasks=tasks, snapshots=snapshots, episodes=episodes)
            command = [sys.executable, __file__, f"--repeats={arguments.repeats}", f"--measure={folder}"]
            subprocess.run(command, check=True)


def measure(folder: Path, repeats: int) -> dict[str, Any]:
    """The results of one size."""
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    opening = _opening(folder, repeats)
    peak = memory("VmHWM")  # before any peer is loaded
    dataset = tcmrl_data.open_dataset(folder)
    settings = dataset.environment.settings
    work = Work(tasks=16, transitions=256, windows=512, window_length=10, horizon=settings.horizon)
    peers, missing = _peer_draws(_peers.flat_data(dataset.select(split="train")), work, folder)
    rates, copied = _race({"ours": _our_draws(dataset, work)} | peers, repeats)
    dimensions = dataset.environment.observation_dim, dataset.environment.action_dim
    step_bytes = 4 * (2 * dimensions[0] + dimensions[1] + 2)  # two observations, action, reward, terminated
    sizes = {kind: steps * step_bytes for kind, steps in work.steps.items()}
    return {
        "environment": dataset.name,
        "observation_dim": dimensions[0],
        "action_dim": dimensions[1],
        "transitions": dataset.manifest.totals.steps,
        "memcpy_bytes_per_s": _median(copied),
        "ours": _rates(rates["ours"], sizes),
        "peers": {name: _rates(rates[name], sizes) for name in peers} | missing,
        **{name: _median(values) for name, values in opening.items()},
        "peak_rss_bytes": peak,
        "ours_over_peers": {name: _ratios(rates["ours"], rates[name]) for name in peers},
        "ours_over_memcpy": {
            kind: _ratio([rate * sizes[kind] for rate in values], copied)
            for kind, values in rates["ours"].items()
        },
        "open_over_read": _ratio(*opening.values()),
        "spread": {
            name: _spread(values) for name, values in (opening | {"memcpy_bytes_per_s": copied}).items()
        },
        "repeats": repeats,
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "versions": {name: _version(name) for name in ("torch", "torchrl", "minari", "stable-baselines3")},
    }


def _opening(folder: Path, repeats: int) -> dict[str, list[float]]:
    """Seconds from opening to the first full batch, and for reading and decompressing the same files once."""
    kinds = {
        "policy": Transitions(256),
        "context": Trajectories(1),
        "execution": Trajectories(1, apart_from="context"),
        "windows": Windows(32, length=10),
    }
    request = tcmrl_data.BatchRequest(tasks=16, kinds=kinds)
    files = list(folder.glob(f"{PARTS}/*/*/*.zip"))
    first_batch: list[float] = []
    reading: list[float] = []
    for _ in range(repeats):
        gc.collect()
        started = time.perf_counter()
        selection = tcmrl_data.open_dataset(folder).select(split="train")
        tcmrl_data.open_sampler(selection, request, seed=0).batch(0)
        first_batch.append(time.perf_counter() - started)
        started = time.perf_counter()
        for file in files:
            with Archive(file) as archive:
                for name in filter(_is_chunk, archive.names):
                    Zstd().decode(archive.read(name)[:-4])  # the last four bytes are the checksum
        reading.append(time.perf_counter() - started)
    return {"open_to_first_batch_s": first_batch, "read_bytes_s": reading}


def _is_chunk(name: str) -> bool:
    """Whether a member of a part's archive holds a chunk of an array."""
    return name.startswith(f"{ARRAYS}/") and not name.endswith("zarr.json")


def _our_draws(dataset: tcmrl_data.Dataset, work: Work) -> dict[str, Draw]:
    """A sampler per kind of batch."""
    selection = dataset.select(split="train")
    wanted = {
        "transitions": {"policy": Transitions(work.transitions)},
        "trajectories": {"context": Trajectories(1)},
        "windows": {"windows": Windows(work.windows // work.tasks, length=work.window_length)},
        "full_step": {
            "policy": Transitions(work.transitions),
            "context": Trajectories(1),
            "execution": Trajectories(1, apart_from="context"),
            "windows": Windows(work.full_windows // work.tasks, length=work.window_length),
        },
    }

    def draw(kind: str) -> Draw:
        request = tcmrl_data.BatchRequest(tasks=work.tasks, kinds=wanted[kind])
        sampler = tcmrl_data.open_sampler(selection, request, seed=0)
        number = iter(range(2**62))
        return lambda: sampler.batch(next(number))

    return {kind: draw(kind) for kind in KINDS}


def _peer_draws(
    data: Data, work: Work, folder: Path
) -> tuple[dict[str, Mapping[str, Draw]], dict[str, dict[str, str]]]:
    """The draws of every peer, and the reason for every peer that cannot be measured."""
    makers: dict[str, Callable[[], dict[str, Mapping[str, Draw]]]] = {
        "torchrl": lambda: {"torchrl": _peers.torchrl_samplers(data, work)},
        "minari": lambda: _peers.minari_datasets(data, work, folder.with_name(f"{folder.name}-minari")),
        "sb3": lambda: {"sb3": _peers.sb3_buffers(data, work)},
        "sequence_loop": lambda: {"sequence_loop": _peers.sequence_loop(data, work)},
    }
    found: dict[str, Mapping[str, Draw]] = {}
    missing: dict[str, dict[str, str]] = {}
    for name, make in makers.items():
        try:
            found |= make()
        except (ImportError, tcmrl_data.TcmrlError) as error:
            missing[name] = {"reason": str(error)}
    return found, missing


def _race(
    draws: Mapping[str, Mapping[str, Draw]], repeats: int
) -> tuple[dict[str, dict[str, list[float]]], list[float]]:
    """Batches per second by contestant, kind and repetition, and bytes per second of a streaming copy."""
    rates: dict[str, dict[str, list[float]]] = {
        name: {kind: [] for kind in kind_draws} for name, kind_draws in draws.items()
    }
    copied: list[float] = []
    source, target = np.ones((2, COPIED_BYTES), dtype=np.uint8)
    for repetition in range(repeats + 1):
        copied.append(COPIED_BYTES * _rate(lambda: np.copyto(target, source)))
        for name, kind_draws in draws.items():
            for kind, draw in kind_draws.items():
                rates[name][kind].append(_rate(draw))
        if repetition == 0:  # warms up
            copied.clear()
            for kind_rates in rates.values():
                for values in kind_rates.values():
                    values.clear()
    return rates, copied


def _rate(draw: Draw) -> float:
    count, started = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - started) < SECONDS or not count:
        draw()
        count += 1
    return count / elapsed


def _rates(rates: Mapping[str, list[float]], sizes: Mapping[str, int]) -> dict[str, Any]:
    """A contestant's kinds: batches per second and bytes per batch; null where it has no such kind."""
    return {
        kind: {
            "batches_per_s": _median(rates[kind]),
            "spread": _spread(rates[kind]),
            "bytes_per_batch": size,
        }
        if kind in rates
        else None
        for kind, size in sizes.items()
    }


def _ratios(ours: Mapping[str, list[float]], theirs: Mapping[str, list[float]]) -> dict[str, Any]:
    return {kind: _ratio(ours[kind], values) for kind, values in theirs.items()}


def _ratio(ones: list[float], others: list[float]) -> dict[str, Any]:
    ratios = [one / other for one, other in zip(ones, others, strict=True)]
    return {"median": _median(ratios), "spread": _spread(ratios)}


def _median(values: list[float]) -> float:
    return float(f"{statistics.median(values):.4g}")


def _spread(values: list[float]) -> list[float]:
    return [float(f"{value:.4g}") for value in (min(values), max(values))]


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


if __name__ == "__main__":
    main()
