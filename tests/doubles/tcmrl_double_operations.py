"""Two operations: the last episodes of a part, and its policy acting with noise from keyed seeds."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from tcmrl_data import Trajectory
from tcmrl_data.envs.rollout import PlaybackController, roll_out
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import Purpose, keyed_generator
from tcmrl_data.parts.operation import Operation, Sources, WantedPart


class LastSettings(Record):
    """Number of episodes."""

    number: int = Field(ge=1)


class LastEpisode(Operation[LastSettings]):
    """The last episodes of a stored part."""

    name = "last-episode"
    Settings = LastSettings
    example: ClassVar[Mapping[str, Any]] = {"number": 2}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        return sources.part.episodes()[-self.settings.number :]


class NoiseSettings(Record):
    """Standard deviation of the noise."""

    sigma: float = Field(gt=0)


class ActionNoise(Operation[NoiseSettings]):
    """Stored actions with noise, played in the simulator of their task."""

    name = "action-noise"
    Settings = NoiseSettings
    simulates = True
    example: ClassVar[Mapping[str, Any]] = {"sigma": 0.1}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        simulator, made = sources.running, []
        stored, number = sources.part.episodes(), simulator.num_lanes
        for first in range(0, len(stored), number):
            key = (simulator.seed, simulator.environment.name, wanted.task.index, Purpose.OPERATION)
            noises = [keyed_generator(*key, wanted.step, first + lane) for lane in range(number)]
            actions = [
                (episode.actions + noise.normal(0.0, self.settings.sigma, episode.actions.shape)).astype(
                    np.float32
                )
                for episode, noise in zip(stored[first : first + number], noises, strict=True)
            ]
            made += roll_out(
                simulator.environment,
                simulator.lanes,
                PlaybackController(actions),
                reset_seeds=[first + lane for lane in range(number)],
                noise=noises,
            )
        return made
