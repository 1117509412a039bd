"""What a build takes: tasks, parts, environment steps, bytes, and a time measured by a short probe."""

import dataclasses
import heapq
import math
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.behavior.base import BehaviorSource, CheckpointFolder, Snapshot
from tcmrl_data.building.plan import BuildPlan, PartMaker
from tcmrl_data.engine.base import ENGINES, Unit
from tcmrl_data.engine.local import Send
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.records import from_json, to_json


@dataclass(frozen=True)
class Forecast:
    """A build before it starts.

    Attributes:
        training_steps: environment steps of behavior training, all tasks together.
        rollout_steps: stored environment steps, at most; episodes may end early.
        bytes: size of the arrays before compression, an upper bound.
        unit_bytes: most memory that a worker takes.
        seconds: expected wall time with `workers` processes on this machine.
    """

    environment: str
    profile: str
    behavior: str
    tasks: int
    train: int
    test: int
    snapshots: int
    parts: int
    episodes: int
    training_steps: int
    rollout_steps: int
    bytes: int
    workers: int
    unit_bytes: int
    seconds: float
    seconds_low: float
    seconds_high: float


def forecast_build(plan: BuildPlan, *, workers: int | None = None) -> Forecast:
    """What a build takes, from its plan and from a few seconds of measuring this machine.

    Args:
        workers: processes at a time; one per core where None.
    """
    recipe, environment, source, chosen = plan.recipe, plan.environment, plan.source, plan.tasks
    workers = workers or available_cores()
    parts = len(chosen) * len(source.steps)
    episodes = parts * recipe.rollouts.episodes
    seconds, low, high = estimate_seconds(plan, workers)
    return Forecast(
        environment=environment.name,
        profile=recipe.profile,
        behavior=recipe.behavior.source,
        tasks=len(chosen),
        train=sum(task.split == "train" for task in chosen),
        test=sum(task.split == "test" for task in chosen),
        snapshots=len(source.steps),
        parts=parts,
        episodes=episodes,
        training_steps=len(chosen) * source.training_steps,
        rollout_steps=episodes * environment.settings.horizon,
        bytes=parts * plan.part_bytes,
        workers=workers,
        unit_bytes=plan.unit_bytes(max(map(len, plan.groups))),
        seconds=seconds,
        seconds_low=low,
        seconds_high=high,
    )


WORKER = "tcmrl_data.building.forecast"
PROBE_TIMEOUT = 600.0
MARGIN = 0.15
"""Added to the spread of the measurements, for what varies over more than their few seconds."""


@dataclass(frozen=True)
class Measurement:
    """What one probe measured, all in seconds.

    Attributes:
        start: from the engine's start to the worker's first word.
        setup: until training could begin.
        warmup: per environment step of the warm-up.
        updates: per environment step with its updates, in the first and the second half of the probe.
        first_part: of a task's first part, with its reference returns.
        stretch: how many times longer rollouts are where no episode ends early.
    """

    start: float
    setup: float
    warmup: float
    updates: tuple[float, ...]
    first_part: float
    part: float
    stretch: float


def estimate_seconds(plan: BuildPlan, workers: int) -> tuple[float, float, float]:
    """Wall time of a build, expected and at both ends of its spread.

    Measures as many of the largest units at once as will run at once, and adds up the build.
    """
    source, sizes = plan.source, [len(group) for group in plan.groups]
    found = _measure(plan, min(workers, len(plan.groups)))
    updates = [rate for one in found for rate in one.updates]
    stretch = max(one.stretch for one in found)

    def add_up(update: float, stretch: float) -> float:
        start = _mean(found, "start") + _mean(found, "setup")
        task = task_seconds(source, found, update=update, stretch=stretch)
        return makespan([start + size * task for size in sizes], workers)

    middle = add_up(sum(updates) / len(updates), (1.0 + stretch) / 2)
    low, high = add_up(min(updates), 1.0), add_up(max(updates), stretch)
    return middle, (1 - MARGIN) * low, (1 + MARGIN) * high


def task_seconds(
    source: BehaviorSource, found: Sequence[Measurement], *, update: float, stretch: float
) -> float:
    """Seconds of one task: warm-up, updates and parts, multiplied by their numbers in the source."""
    warmup_steps = min(source.warmup_steps, source.training_steps)
    training = warmup_steps * _mean(found, "warmup") + (source.training_steps - warmup_steps) * update
    parts = _mean(found, "first_part") + (len(source.steps) - 1) * _mean(found, "part")
    return training + stretch * parts


def makespan(units: Sequence[float], workers: int) -> float:
    """Seconds until the last of some units ends, the longest started first."""
    busy = [0.0] * workers
    for seconds in sorted(units, reverse=True):
        heapq.heapreplace(busy, busy[0] + seconds)
    return max(busy)


def _mean(found: Sequence[Measurement], name: str) -> float:
    values: list[float] = [getattr(one, name) for one in found]
    return sum(values) / len(values)


def _measure(plan: BuildPlan, number: int) -> list[Measurement]:
    """Runs probes of the largest units side by side, since they share the memory's bandwidth."""
    largest = sorted(plan.groups, key=len, reverse=True)[:number]
    units = [
        Unit(
            f"probe of task {group[0].index}",
            to_json(dataclasses.replace(plan, tasks=group)),
            worker=WORKER,
            timeout=PROBE_TIMEOUT,
        )
        for group in largest
    ]
    started = time.monotonic()
    starts: dict[str, float] = {}
    found: list[Measurement] = []

    def take(unit: str, message: Mapping[str, Any]) -> None:
        if message["kind"] == "started":
            starts[unit] = time.monotonic() - started
        elif message["kind"] == "measured":
            values = {name: value for name, value in message.items() if name not in ("kind", "updates")}
            found.append(Measurement(start=starts[unit], updates=tuple(message["updates"]), **values))

    for result in ENGINES.get("local")(number).run(units, take):
        if not result.ok:
            raise BuildError(f"{result.id} failed: {result.error}")
    return found


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
    """Measures the unit of a plan and sends what it measured; its parts have a single lane batch."""
    import torch

    torch.set_num_threads(1)  # as a build's workers
    send({"kind": "started"})
    whole = from_json(BuildPlan, values)
    rollouts = whole.recipe.rollouts
    batch = rollouts.model_copy(update={"episodes": rollouts.lanes})
    plan = dataclasses.replace(whole, recipe=whole.recipe.model_copy(update={"rollouts": batch}))
    source = plan.source.with_warmup(WARMUP_STEPS)
    clock = Clock(source.warmup_steps * len(plan.tasks))
    nowhere = CheckpointFolder(Path(os.devnull), "", key="", missing={}, seconds=math.inf)
    context = plan.context(clock.report, lambda tasks: nowhere)
    started = time.monotonic()
    try:
        for index, (task, snapshot) in enumerate(source.snapshots(context)):
            if index == 0:
                setup = time.monotonic() - started
                parts = _measure_parts(plan, task, snapshot, batches=rollouts.episodes / rollouts.lanes)
                clock.restart()
            if index == 1 and not source.training_steps:
                break
    except ProbeOverError:
        pass
    send({"kind": "measured", "setup": setup, **parts, **clock.measured()})
    return ""


def _measure_parts(plan: BuildPlan, task: Task, snapshot: Snapshot, *, batches: float) -> dict[str, float]:
    """Seconds of a task's first part and of one more, and how many times longer full episodes would be.

    Args:
        plan: with one lane batch per part.
        batches: number of lane batches of a whole part.
    """
    seconds = []
    with tempfile.TemporaryDirectory(prefix="tcmrl-probe-") as name:
        maker = PartMaker(Path(name), plan, task=task, behavior={})
        for step in (0, 1):
            started = time.monotonic()
            published = maker.publish(dataclasses.replace(snapshot, step=step))
            assert published is not None  # the folder is new
            found = published.entry
            if len(plan.tasks) > 1:
                maker.close()
            seconds.append((time.monotonic() - started) * batches)
        maker.close()
    stretch = plan.environment.settings.horizon * found.episodes / max(1, found.steps)
    return {"first_part": seconds[0], "part": seconds[1], "stretch": stretch}
