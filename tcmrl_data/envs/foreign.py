"""The environment of imported data whose environment is not installed: only sizes are known."""

from typing import Any, Literal, NoReturn, final

import numpy as np
from pydantic import Field, model_validator

from tcmrl_data.envs.base import Environment, EnvironmentSettings, ObservationView, Parameters, Reward
from tcmrl_data.foundation.errors import SimulationError


class ForeignSettings(EnvironmentSettings):
    """What the data themselves say about their environment.

    Attributes:
        tasks: number of imported tasks, at least one.
        train: number of training tasks among them, possibly all.
        horizon: steps of the longest episode.
        extra_arrays: dtypes of further per-step arrays, by name.
    """

    tasks: int = Field(ge=1)
    train: int = Field(ge=0)
    observation_dim: int = Field(ge=1)
    action_dim: int = Field(ge=1)
    extra_arrays: dict[str, Literal["float32", "int64", "bool"]] = Field(default={})

    @model_validator(mode="after")
    def _some_test_tasks(self) -> "ForeignSettings":
        if self.train > self.tasks:
            raise ValueError(f"train ({self.train}) must not be larger than tasks ({self.tasks})")
        return self


@final
class Foreign(Environment):
    """Sizes and horizon of imported data, where readers of a dataset always find them.

    A recipe file cannot name it, and everything that needs a simulation is refused.
    """

    name = "foreign"
    Settings = ForeignSettings
    settings: ForeignSettings

    def __init__(self, settings: ForeignSettings) -> None:
        super().__init__(settings)
        self.observation_dim, self.action_dim = settings.observation_dim, settings.action_dim
        # a class attribute elsewhere; here datasets differ
        self.extras = {name: np.dtype(dtype).type for name, dtype in settings.extra_arrays.items()}  # type: ignore[misc]

    @classmethod
    def members(cls) -> list[str]:
        """None, because it cannot be built."""
        return []

    @classmethod
    def provides(cls, name: str) -> bool:
        return name == cls.name

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        _refuse()

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> NoReturn:
        _refuse()


def _refuse() -> NoReturn:
    raise SimulationError(
        "the data were imported without an environment, so that nothing can be simulated; import them again "
        "with --environment NAME if they come from one that `tcmrl-data envs` lists"
    )
