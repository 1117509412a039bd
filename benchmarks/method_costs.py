"""Measures what a training step of every method costs, by turns in one process. Prints JSON.

`python benchmarks/method_costs.py DATASET [--profile NAME] [--set KEY=VALUE] [--steps N] [--threads N]`

Every method trains STEPS steps on the dataset, by the training table that the dataset keeps; a method in
stages goes through all of them, in the shares that its table states. Steps that come before the first logged
one do not count. Methods take turns: a round is one run of each, a number the median over the rounds, and
`over_focal` the median of the ratios within a round, of wall-clock and of processor time.
"""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from _timing import median

from tcmrl_algo import METHODS, TrainingProgress, resolve_for, train_run
from tcmrl_data import Dataset, open_dataset

LOG_EVERY = 10
REFERENCE = "focal"
Clocks = tuple[float, float]


def measure(dataset: Dataset, name: str, options: argparse.Namespace) -> tuple[Clocks, dict[str, float]]:
    """Milliseconds a step: of wall-clock and of processor time, and of wall-clock time by stage."""
    sizes = (f"run.steps={options.steps}", f"run.log_every={LOG_EVERY}", f"run.threads={options.threads}")
    config = resolve_for(
        dataset, profile=options.profile, algorithm=name, overrides=(*options.overrides, *sizes)
    )
    marks: list[tuple[int, float, float]] = []
    stages: dict[str, list[float]] = {}

    def report(progress: TrainingProgress) -> None:
        marks.append((progress.step, time.perf_counter(), time.process_time()))
        if len(marks) > 1:
            stages.setdefault(progress.stage, []).append(1000 / progress.rate)

    with tempfile.TemporaryDirectory() as folder:
        train_run(dataset, Path(folder) / "run", config=config, profile=options.profile, report=report)
    (first, *began), (last, *ended) = marks[0], marks[-1]
    wall, processor = (
        1000 * (until - since) / (last - first) for since, until in zip(began, ended, strict=True)
    )
    return (wall, processor), {stage: median(values) for stage, values in stages.items()}


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("dataset")
    parser.add_argument("--profile", default="reduced")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    dataset = open_dataset(options.dataset)
    rounds = [
        {name: measure(dataset, name, options) for name in METHODS.names()} for _ in range(options.rounds)
    ]
    methods: dict[str, Any] = {}
    for name in METHODS.names():
        clocks = [found[name][0] for found in rounds]
        beside = [found[REFERENCE][0] for found in rounds]
        methods[name] = {
            "ms": median([wall for wall, _ in clocks]),
            "processor_ms": median([processor for _, processor in clocks]),
            "over_focal": median([own[0] / other[0] for own, other in zip(clocks, beside, strict=True)]),
            "over_focal_processor": median(
                [own[1] / other[1] for own, other in zip(clocks, beside, strict=True)]
            ),
            "stages": {
                stage: median([found[name][1][stage] for found in rounds]) for stage in rounds[0][name][1]
            },
        }
    document = {
        "dataset": dataset.name,
        "root": dataset.manifest.root,
        "profile": options.profile,
        "overrides": options.overrides,
        "steps": options.steps,
        "rounds": options.rounds,
        "threads": options.threads,
        "torch": torch.__version__,
        "load_average": os.getloadavg()[0],
        "methods": methods,
    }
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
