"""Stored episodes simulated again in another task, for its rewards; everything else must come back."""

from collections.abc import Mapping
from typing import Any, ClassVar, final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from tcmrl_data.envs.base import Task
from tcmrl_data.envs.controller import PlaybackController, Trajectory
from tcmrl_data.envs.rollout import roll_out
from tcmrl_data.foundation.errors import SimulationError
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import Purpose, keyed_seed
from tcmrl_data.parts.operation import Operation, Sources, WantedPart
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.tables import MAX_INDEX

RELABEL = "relabel"


class RelabelSettings(Record):
    """Settings of a relabelled part.

    Attributes:
        task: the task that the episodes come from.
        first_episode: number of the part's first episode among those of its keyed seeds.
    """

    task: int = Field(ge=0, lt=MAX_INDEX)
    first_episode: int = Field(ge=0, lt=MAX_INDEX)


@final
class Relabel(Operation[RelabelSettings]):
    """Stored episodes with the rewards of another task: each is reset with its seed and played again."""

    name = RELABEL
    kinds = ("relabelled",)
    Settings = RelabelSettings
    simulates = True
    keeps = ("observations", "actions", "episode_offsets")
    example: ClassVar[Mapping[str, Any]] = {"first_episode": 0}

    @classmethod
    def settings_for(cls, settings: Mapping[str, Any], source: Task) -> Mapping[str, Any]:
        """The settings with the task of the episodes."""
        return {"task": source.index, **settings}

    @classmethod
    def settings_of(cls, run: Run, source: Run) -> Mapping[str, Any]:
        """The first episode of the parts that are relabelled."""
        return {"first_episode": first_episode_of(source)}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The episodes of the part with the rewards of the wanted part's task.

        Raises:
            SimulationError: an observation or an episode's end is not as stored; names the first step.
        """
        simulator, settings = sources.running, self.settings
        trajectories, lanes = sources.part.episodes(), simulator.lanes
        key = (
            simulator.seed,
            simulator.environment.name,
            settings.task,
            Purpose.ROLLOUT_RESET,
            wanted.step,
        )
        made: list[Trajectory] = []
        for first in range(0, len(trajectories), lanes.num_lanes):
            batch = trajectories[first : first + lanes.num_lanes]
            numbers = range(settings.first_episode + first, settings.first_episode + first + len(batch))
            again = roll_out(
                simulator.environment,
                lanes,
                PlaybackController([episode.actions for episode in batch]),
                reset_seeds=[keyed_seed(*key, number) for number in numbers],
                noise=[np.random.default_rng(0) for _ in batch],  # drawn by every rollout, and not used
            )
            for number, old, new in zip(numbers, batch, again, strict=True):
                _check_equal(old, new, f"task {settings.task}, step {wanted.step}", number, wanted.task)
            made += again
        return made

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """Episodes start as those of the task that they come from."""
        return self.settings.task, self.settings.first_episode + number


def first_episode_of(run: Run) -> int:
    """Number of the first episode of a run's parts: 0, but for extended ones."""
    return int((run.origin or {}).get("first_episode", 0))


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
