"""The process that measures one unit for a forecast: `python -m tcmrl_data.building.probe`.

It trains the unit's tasks with the recipe's own networks, group and update rates, but a short warm-up, makes
two parts in a temporary folder, and stops when enough updates were seen.
"""

import dataclasses
import math
import os
import tempfile
import time
from pathlib import Path
from typing import Any

from tcmrl_data.behavior.base import BehaviorContext
from tcmrl_data.behavior.checkpoints import CheckpointFolder
from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.building.unit import PartMaker, UnitSpec
from tcmrl_data.engine.worker import Send, serve
from tcmrl_data.envs.tasks import Task

WARMUP_STEPS = 200
UPDATE_SECONDS = 6.0
LEAST_MARKS = 3
"""Reports of training steps that are waited for, however long they take."""


class ProbeOverError(Exception):
    """Ends behavior training once enough has been measured."""


class Clock:
    """Times the reports of a training: first its warm-up, then its updates."""

    def __init__(self, warmup_count: int) -> None:
        self._warmup_count = warmup_count
        self.restart()

    def restart(self) -> None:
        """Starts again; nothing of the warm-up may be done before."""
        self._marks = [(time.monotonic(), 0)]

    def report(self, count: int) -> None:
        """Takes a source's report of environment steps."""
        now = time.monotonic()
        self._marks.append((now, self._marks[-1][1] + count))
        updates = self._updates()
        if len(updates) >= LEAST_MARKS and now - updates[0][0] > UPDATE_SECONDS:
            raise ProbeOverError

    def _updates(self) -> list[tuple[float, int]]:
        """Marks after the warm-up and the first report of updates, when libraries set themselves up."""
        return [mark for mark in self._marks if mark[1] > self._warmup_count]

    def measured(self) -> dict[str, float | list[float]]:
        """Seconds per environment step of the warm-up, and of updates in two halves."""
        updates = self._updates()
        warmup = [mark for mark in self._marks if mark[1] <= self._warmup_count]
        middle = len(updates) // 2
        halves = [_rate(part) for part in (updates[: middle + 1], updates[middle:]) if len(part) > 1]
        halves = halves or [_rate(self._marks)]
        return {"warmup": _rate(warmup) if len(warmup) > 1 else halves[0], "updates": halves}


def _rate(marks: list[tuple[float, int]]) -> float:
    steps = marks[-1][1] - marks[0][1]
    return (marks[-1][0] - marks[0][0]) / steps if steps else 0.0


def work(values: dict[str, Any], send: Send) -> str:
    """Measures the unit of these values and sends what it measured."""
    import torch

    torch.set_num_threads(1)  # as a build's workers
    send({"kind": "started"})
    spec = UnitSpec.from_json(values)
    plan = _probe_plan(spec)
    source = plan.source.with_warmup(WARMUP_STEPS)
    clock = Clock(source.warmup_steps * len(spec.tasks))
    context = BehaviorContext(
        environment=plan.environment,
        tasks=spec.tasks,
        seed=spec.seed,
        observation=spec.recipe.behavior.observation,
        reward=spec.recipe.behavior.reward,
        report=clock.report,
        checkpoints=lambda tasks: CheckpointFolder(
            Path(os.devnull), "", key="", missing={}, seconds=math.inf
        ),
    )
    started = time.monotonic()
    try:
        for index, (task, snapshot) in enumerate(source.snapshots(context)):
            if index == 0:
                setup = time.monotonic() - started
                parts = _measure_parts(spec, plan, task, snapshot)
                clock.restart()
            if index == 1 and not source.training_steps:
                break
    except ProbeOverError:
        pass
    send({"kind": "measured", "setup": setup, **parts, **clock.measured()})
    return ""


def _probe_plan(spec: UnitSpec) -> BuildPlan:
    """The plan of the unit with a single lane batch per part."""
    rollouts = spec.recipe.rollouts.model_copy(update={"episodes": spec.recipe.rollouts.lanes})
    recipe = spec.recipe.model_copy(update={"rollouts": rollouts})
    return BuildPlan.of_tasks(recipe, seed=spec.seed, tasks=spec.tasks)


def _measure_parts(spec: UnitSpec, plan: BuildPlan, task: Task, snapshot: Snapshot) -> dict[str, float]:
    """Seconds of a task's first part and of one more, and how many times longer full episodes would be."""
    batches = spec.recipe.rollouts.episodes / plan.recipe.rollouts.episodes
    seconds = []
    with tempfile.TemporaryDirectory(prefix="tcmrl-probe-") as name:
        maker = PartMaker(Path(name), plan, task=task, behavior={})
        for step in (0, 1):
            started = time.monotonic()
            published = maker.publish(dataclasses.replace(snapshot, step=step))
            assert published is not None  # the folder is new
            found = published.entry
            if len(spec.tasks) > 1:
                maker.close()
            seconds.append((time.monotonic() - started) * batches)
        maker.close()
    stretch = plan.environment.settings.horizon * found.episodes / max(1, found.steps)
    return {"first_part": seconds[0], "part": seconds[1], "stretch": stretch}


if __name__ == "__main__":
    serve(work)
