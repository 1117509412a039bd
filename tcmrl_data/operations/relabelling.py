"""Rewards of another task by simulating stored episodes again: they are kept only if nothing else differs."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from pydantic import Field

from tcmrl_data.envs.base import Environment, Lanes
from tcmrl_data.envs.controller import PlaybackController
from tcmrl_data.envs.rollout import roll_out
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import SimulationError
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import Purpose, keyed_seed
from tcmrl_data.store.limits import MAX_INDEX

RELABEL = "relabel"
"""The operation's name in records."""


class Relabelling(Record):
    """Settings of a relabelled part.

    Attributes:
        task: the task that the episodes come from.
        first_episode: number of the part's first episode among those of its keyed seeds.
    """

    task: int = Field(ge=0, lt=MAX_INDEX)
    first_episode: int = Field(ge=0, lt=MAX_INDEX)


def relabelled_episodes(
    environment: Environment,
    trajectories: Sequence[Trajectory],
    *,
    settings: Relabelling,
    step: int,
    seed: int,
    target: Task,
    lanes: Lanes,
) -> list[Trajectory]:
    """Stored episodes with the rewards of another task.

    Every episode is reset with its keyed seed in the other task, and plays its actions again.

    Args:
        environment: of both tasks.
        trajectories: as many stored episodes as the lanes, or a multiple.
        settings: where the episodes come from.
        step: their snapshot step.
        seed: their root seed.
        target: the other task.
        lanes: of the other task.

    Raises:
        SimulationError: an observation or an episode's end is not as stored; names the first step.
    """
    made: list[Trajectory] = []
    key = (seed, environment.name, settings.task, Purpose.ROLLOUT_RESET, step)
    for first in range(0, len(trajectories), lanes.num_lanes):
        batch = trajectories[first : first + lanes.num_lanes]
        numbers = range(settings.first_episode + first, settings.first_episode + first + len(batch))
        again = roll_out(
            environment,
            lanes,
            PlaybackController([episode.actions for episode in batch]),
            reset_seeds=[keyed_seed(*key, number) for number in numbers],
            noise=[np.random.default_rng(0) for _ in batch],  # drawn by every rollout, and not used
        )
        for number, old, new in zip(numbers, batch, again, strict=True):
            _check_equal(old, new, f"task {settings.task}, step {step}", number, target)
        made += again
    return made


def _check_equal(old: Trajectory, new: Trajectory, part: str, episode: int, target: Task) -> None:
    rows = min(len(old.observations), len(new.observations))
    unequal = (_bits(old)[:rows] != _bits(new)[:rows]).any(axis=1)
    if unequal.any() or len(old) != len(new):
        step = int(unequal.argmax()) if unequal.any() else rows - 1
        what = "observations differ" if unequal.any() else "one of the two ends"
        raise SimulationError(
            f"{part}: cannot be relabelled to task {target.index}, which has other dynamics or starts: "
            f"{what} at step {step} of episode {episode}, so that rewards would be invented"
        )


def _bits(trajectory: Trajectory) -> npt.NDArray[np.uint32]:
    """The observations, of which -0 and 0 differ and NaN equals NaN."""
    return np.ascontiguousarray(trajectory.observations, dtype=np.float32).view(np.uint32)
