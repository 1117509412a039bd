"""What a build takes: tasks, parts, environment steps, bytes, and a time measured by a short probe."""

import contextlib
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.behavior.base import BehaviorContext
from tcmrl_data.behavior.checkpoints import CheckpointFolder
from tcmrl_data.build.plan import BuildPlan
from tcmrl_data.envs.controller import UniformController
from tcmrl_data.envs.rollout import roll_out
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed

PROBE_SECONDS = 6.0
UNIT_START_SECONDS = 3.0
"""Starting a worker process, mostly importing torch; measured as 2 to 4 s."""


@dataclass(frozen=True)
class Forecast:
    """A build before it starts.

    Attributes:
        training_steps: environment steps of behavior training, all tasks together.
        rollout_steps: stored environment steps, at most; episodes may end early.
        bytes: size of the arrays before compression, an upper bound.
        unit_bytes: most memory that a worker takes.
        seconds: estimated wall time with `workers` processes on this machine.
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


class _ProbeOverError(Exception):
    """Ends behavior training once enough has been measured."""


def forecast_build(plan: BuildPlan, *, workers: int | None = None) -> Forecast:
    """What a build takes, from its plan and from a few seconds of measuring this machine.

    Args:
        plan: of the build.
        workers: processes at a time; one per core where None.
    """
    recipe, environment, source, chosen = plan.recipe, plan.environment, plan.source, plan.tasks
    workers = workers or available_cores()
    episodes, horizon = recipe.rollouts.episodes, environment.settings.horizon
    parts = len(chosen) * len(source.steps)
    largest = max(plan.groups, key=len)
    task_seconds = source.training_steps * _training_seconds_per_step(plan, largest)
    task_seconds += len(source.steps) * episodes * _seconds_per_episode(plan, chosen[0])
    unit_seconds = UNIT_START_SECONDS + len(largest) * task_seconds
    return Forecast(
        environment=environment.name,
        profile=recipe.profile,
        behavior=recipe.behavior["source"],
        tasks=len(chosen),
        train=sum(task.split == "train" for task in chosen),
        test=sum(task.split == "test" for task in chosen),
        snapshots=len(source.steps),
        parts=parts,
        episodes=parts * episodes,
        training_steps=len(chosen) * source.training_steps,
        rollout_steps=parts * episodes * horizon,
        bytes=parts * plan.part_bytes,
        workers=workers,
        unit_bytes=plan.unit_bytes(len(largest)),
        seconds=unit_seconds * math.ceil(len(plan.groups) / workers),
    )


def _training_seconds_per_step(plan: BuildPlan, tasks: Sequence[Task]) -> float:
    """Measured on a real training of the tasks, at the end of the probe, when the warm-up is over."""
    marks: list[tuple[float, int]] = []
    started = time.monotonic()

    def report(count: int) -> None:
        now = time.monotonic()
        marks.append((now, count))
        if now - started > PROBE_SECONDS:
            raise _ProbeOverError

    context = BehaviorContext(
        environment=plan.environment,
        tasks=tasks,
        seed=0,
        observation=plan.recipe.behavior["observation"],
        reward=plan.recipe.behavior["reward"],
        report=report,
        checkpoints=lambda tasks: CheckpointFolder(Path(os.devnull), "", key="", before=0, seconds=math.inf),
    )
    with contextlib.suppress(_ProbeOverError):
        for _ in plan.source.snapshots(context):
            pass
    late = [mark for mark in marks if mark[0] > started + PROBE_SECONDS / 2] or marks
    if len(late) < 2:
        return 0.0 if not marks else (marks[-1][0] - started) / sum(count for _, count in marks)
    return (late[-1][0] - late[0][0]) / sum(count for _, count in late[1:])


def _seconds_per_episode(plan: BuildPlan, task: Task) -> float:
    """Measured on one lane batch of uniform actions; a policy's own cost is small beside it."""
    environment, num_lanes = plan.environment, plan.recipe.rollouts.lanes
    lanes = environment.lanes([task.parameters] * num_lanes)
    key = (0, environment.name, task.index)
    started = time.monotonic()
    roll_out(
        environment,
        lanes,
        UniformController(),
        reset_seeds=[keyed_seed(*key, Purpose.REFERENCE_RESET, lane) for lane in range(num_lanes)],
        noise=[keyed_generator(*key, Purpose.REFERENCE_NOISE, lane) for lane in range(num_lanes)],
    )
    lanes.close()
    return (time.monotonic() - started) / num_lanes
