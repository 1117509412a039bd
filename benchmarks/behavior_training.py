"""Task-steps per second per core of behavior training, `stacked` against Stable-Baselines3, as JSON.

    python benchmarks/behavior_training.py [--quick] [--seconds 10]

A task-step is one environment step of one task with its update, in the real environment. The measurement
starts after the warm-up. Both sources run in this process with one thread, in float32 except for the rows
of precision `medium`. Seconds are CPU seconds of the process, so other load on the machine has little
effect. Every `sac` row is followed by the `stacked` rows of the same setting.
"""

import argparse
import json
import math
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tcmrl_data import Recipe, load_recipe
from tcmrl_data.behavior.base import BehaviorContext, CheckpointFolder
from tcmrl_data.recipe.recipe import choose_tasks

SETTINGS = [
    ("point-robot-wind", 64, 128),
    ("half-cheetah-vel", 64, 128),
    ("half-cheetah-vel", 128, 128),
    ("half-cheetah-vel", 256, 256),
]
GROUPS = [1, 4, 16, 50]
MEDIUM_GROUP = 16
"""Agents of the row that is measured again with matrix products in reduced precision."""
WARMUP = 300
SETTLING = 40
"""Steps with updates before the clock starts."""


class _OverError(Exception):
    """Ends a training after the measurement."""


def measure(recipe: Recipe, num_tasks: int, seconds: float) -> float:
    """Task-steps per CPU second of one process that trains the recipe's first tasks."""
    marks: list[tuple[float, int]] = []
    steps = 0

    def report(count: int) -> None:
        nonlocal steps
        steps += count
        if steps > (WARMUP + SETTLING) * num_tasks:
            marks.append((time.process_time(), steps))
            if len(marks) > 1 and marks[-1][0] - marks[0][0] > seconds:
                raise _OverError

    context = BehaviorContext(
        environment=recipe.make_environment(),
        tasks=choose_tasks(recipe, range(num_tasks)),
        seed=0,
        observation=recipe.behavior.observation,
        reward=recipe.behavior.reward,
        report=report,
        checkpoints=lambda tasks: CheckpointFolder(
            Path(os.devnull), "", key="", missing={}, seconds=math.inf
        ),
    )
    try:
        for _ in recipe.make_source().snapshots(context):
            pass
    except _OverError:
        pass
    (begun, first), (ended, last) = marks[0], marks[-1]
    return (last - first) / (ended - begun)


def recipe_of(name: str, source: str, width: int, batch_size: int, *more: str) -> Recipe:
    """The environment's recipe with the network and batch of a setting, and more overrides."""
    settings = {
        "hidden": [width, width],
        "batch_size": batch_size,
        "warmup": WARMUP,
        "steps": 1_000_000,
        "snapshots": [0, 1_000_000],
        "buffer_size": 20_000,
    }
    overrides = [f"behavior.sac.{key}={value}" for key, value in settings.items()]
    return load_recipe(name, behavior=source, overrides=[*overrides, *more])


def rows(seconds: float, groups: list[int]) -> Iterator[dict[str, Any]]:
    """One row per setting and source, and per group size where stacked."""
    for name, width, batch_size in SETTINGS:
        setting = {"environment": name, "width": width, "batch_size": batch_size}
        base = measure(recipe_of(name, "sac", width, batch_size), 1, seconds)
        yield setting | {
            "source": "sac",
            "tasks": 1,
            "precision": "highest",
            "task_steps_per_second": base,
            "times_sac": 1.0,
        }
        for num_tasks, precision in [*((group, "highest") for group in groups), (MEDIUM_GROUP, "medium")]:
            override = f"behavior.stacked.matmul_precision={precision}"
            rate = measure(recipe_of(name, "stacked", width, batch_size, override), num_tasks, seconds)
            measured = {"task_steps_per_second": rate, "times_sac": rate / base}
            yield setting | {"source": "stacked", "tasks": num_tasks, "precision": precision} | measured


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="2 seconds a row, groups of 1 and 16")
    parser.add_argument("--seconds", type=float, default=10.0, help="CPU seconds a row")
    arguments = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    measured = []
    for row in rows(2.0 if arguments.quick else arguments.seconds, [1, 16] if arguments.quick else GROUPS):
        print(json.dumps(row), file=sys.stderr)
        measured.append(row)
    machine = {"platform": platform.platform(), "torch": torch.__version__, "cores_used": 1}
    print(json.dumps({"benchmark": "behavior_training", "machine": machine, "rows": measured}, indent=2))


if __name__ == "__main__":
    main()
