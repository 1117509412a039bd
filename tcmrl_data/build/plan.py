"""What a build will take: tasks, parts, environment steps, bytes, and a time measured by a short probe."""

import contextlib
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.behavior.base import BehaviorContext
from tcmrl_data.behavior.checkpoints import CheckpointFolder
from tcmrl_data.build.part import part_bytes
from tcmrl_data.build.unit import behavior_source, unit_memory
from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.controller import UniformController
from tcmrl_data.envs.rollout import roll_out
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.recipe.tasks import choose_tasks, group_tasks

PROBE_SECONDS = 6.0
UNIT_START_SECONDS = 3.0
"""Starting a worker process, mostly importing torch; measured as 2 to 4 s."""


@dataclass(frozen=True)
class Plan:
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


def plan_build(recipe: Recipe, *, tasks: Sequence[int] | None = None, workers: int | None = None) -> Plan:
    """Plans a build and measures this machine for a few seconds.

    Raises:
        TaskError: an index outside the task set.
    """
    chosen = choose_tasks(recipe, tasks)
    environment, source = recipe.make_environment(), behavior_source(recipe)
    workers = workers or available_cores()
    episodes, horizon = recipe.rollouts.episodes, environment.settings.horizon
    parts = len(chosen) * len(source.steps)
    groups = group_tasks(chosen, source.group_size)
    largest = max(groups, key=len)
    task_seconds = source.training_steps * _training_seconds_per_step(recipe, environment, largest)
    task_seconds += len(source.steps) * episodes * _seconds_per_episode(recipe, environment, chosen[0])
    unit_seconds = UNIT_START_SECONDS + len(largest) * task_seconds
    return Plan(
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
        bytes=parts * part_bytes(recipe),
        workers=workers,
        unit_bytes=unit_memory(recipe, len(largest)),
        seconds=unit_seconds * math.ceil(len(groups) / workers),
    )


def _training_seconds_per_step(recipe: Recipe, environment: Environment, tasks: Sequence[Task]) -> float:
    """Measured on a real training of the tasks, at the end of the probe, when the warm-up is over."""
    marks: list[tuple[float, int]] = []
    started = time.monotonic()

    def report(count: int) -> None:
        now = time.monotonic()
        marks.append((now, count))
        if now - started > PROBE_SECONDS:
            raise _ProbeOverError

    context = BehaviorContext(
        environment=environment,
        tasks=tasks,
        seed=0,
        observation=recipe.behavior["observation"],
        reward=recipe.behavior["reward"],
        report=report,
        checkpoints=lambda tasks: CheckpointFolder(Path(os.devnull), "", key="", before=0, seconds=math.inf),
    )
    with contextlib.suppress(_ProbeOverError):
        for _ in behavior_source(recipe).snapshots(context):
            pass
    late = [mark for mark in marks if mark[0] > started + PROBE_SECONDS / 2] or marks
    if len(late) < 2:
        return 0.0 if not marks else (marks[-1][0] - started) / sum(count for _, count in marks)
    return (late[-1][0] - late[0][0]) / sum(count for _, count in late[1:])


def _seconds_per_episode(recipe: Recipe, environment: Environment, task: Task) -> float:
    """Measured on one lane batch of uniform actions; a policy's own cost is small beside it."""
    num_lanes = recipe.rollouts.lanes
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
