"""The source `scripted`: the environment's expert with Gaussian noise; a noise level is a snapshot."""

from collections.abc import Iterator
from typing import final

from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.behavior.base import BehaviorContext, BehaviorSource, ScriptedDescription, Snapshot
from tcmrl_data.envs.base import Environment, Task


class ScriptedSettings(BaseModel):
    """The `[behavior.scripted]` table.

    Attributes:
        noise: standard deviations in falling order; the n-th, counted from 0, is snapshot step n.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    noise: tuple[float, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _noisiest_first(self) -> "ScriptedSettings":
        if list(self.noise) != sorted(set(self.noise), reverse=True) or min(self.noise) < 0:
            raise ValueError(f"noise must fall from noisiest to cleanest, got {list(self.noise)}")
        return self


@final
class ScriptedSource(BehaviorSource):
    """Experts with the full view; they need no training."""

    name = "scripted"
    Settings = ScriptedSettings
    settings: ScriptedSettings

    @property
    def steps(self) -> tuple[int, ...]:
        return tuple(range(len(self.settings.noise)))

    @property
    def training_steps(self) -> int:
        return 0

    def training_bytes(self, environment: Environment, num_tasks: int) -> int:
        return 0

    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        for task in context.tasks:
            for step, noise in enumerate(self.settings.noise):
                yield task, Snapshot(step, ScriptedDescription(observation="full", noise=noise))
