"""How long a build takes on this machine, measured on short runs of its own units."""

import heapq
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.behavior.base import BehaviorSource
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.building.unit import UnitSpec
from tcmrl_data.engine.base import ENGINES, Unit
from tcmrl_data.foundation.errors import BuildError

WORKER = "tcmrl_data.building.probe"
PROBE_TIMEOUT = 600.0
MARGIN = 0.15
"""Added to the spread of the measurements, for what varies over more than their few seconds."""


@dataclass(frozen=True)
class Duration:
    """Wall time of a build in seconds: the expected one, and the ends of its spread."""

    seconds: float
    seconds_low: float
    seconds_high: float


@dataclass(frozen=True)
class Measurement:
    """What one probe measured, all in seconds.

    Attributes:
        start: from the engine's start to the worker's first word.
        setup: until training could begin.
        warmup: per environment step of the warm-up.
        updates: per environment step with its updates, in the first and the second half of the probe.
        first_part: of a task's first part, with its reference returns.
        part: of every further part.
        stretch: how many times longer rollouts are where no episode ends early.
    """

    start: float
    setup: float
    warmup: float
    updates: tuple[float, ...]
    first_part: float
    part: float
    stretch: float


def estimate_duration(plan: BuildPlan, workers: int) -> Duration:
    """Measures as many of the largest units at once as will run at once, and adds up the build.

    Args:
        plan: of the build.
        workers: units that run at the same time.

    Raises:
        BuildError: a probe failed, as the build would.
    """
    source, sizes = plan.source, [len(group) for group in plan.groups]
    found = _measure(plan, min(workers, len(plan.groups)))
    updates = [rate for one in found for rate in one.updates]
    stretch = max(one.stretch for one in found)

    def add_up(update: float, stretch: float) -> float:
        task = task_seconds(source, found, update=update, stretch=stretch)
        return makespan(
            [_mean(found, "start") + _mean(found, "setup") + size * task for size in sizes], workers
        )

    middle = add_up(sum(updates) / len(updates), (1.0 + stretch) / 2)
    low, high = add_up(min(updates), 1.0), add_up(max(updates), stretch)
    return Duration(middle, (1 - MARGIN) * low, (1 + MARGIN) * high)


def task_seconds(
    source: BehaviorSource, found: Sequence[Measurement], *, update: float, stretch: float
) -> float:
    """Seconds of one task: warm-up, updates and parts, multiplied by their numbers.

    Args:
        source: says how many of them there are.
        found: what the probes measured.
        update: seconds per environment step with its updates.
        stretch: by how much rollouts take longer than the probes'.
    """
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
            UnitSpec(Path(), plan.recipe, plan.seed, group).to_json(),
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
