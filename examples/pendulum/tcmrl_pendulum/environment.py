"""Gymnasium's Pendulum-v1, whose gravity, mass and length differ from task to task."""

from importlib.metadata import version
from typing import TYPE_CHECKING, Any, final

import gymnasium
import numpy as np
from pydantic import Field

from tcmrl_data.envs.base import (
    Environment,
    EnvironmentSettings,
    FigureCamera,
    FloatArray,
    ObservationView,
    Parameters,
    Reward,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOMINAL = {"gravity": 10.0, "mass": 1.0, "length": 1.0}
"""Pendulum-v1's own values, in m/s², kg and m."""


class PendulumSettings(EnvironmentSettings):
    """The `[environment]` table.

    Attributes:
        spread: every parameter is drawn uniformly from its nominal value times [1 - spread, 1 + spread].
    """

    spread: float = Field(gt=0, lt=1)


@final
class Pendulum(Environment):
    """Swing a pendulum up without knowing its physics; the reward is Gymnasium's."""

    name = "pendulum"
    Settings = PendulumSettings
    observation_dim = 3
    action_dim = 1
    settings: PendulumSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        spread = self.settings.spread
        factors = np.random.default_rng(task_seed).uniform(1 - spread, 1 + spread, (num_tasks, len(NOMINAL)))
        return [dict(zip(NOMINAL, (row * list(NOMINAL.values())).tolist(), strict=True)) for row in factors]

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> gymnasium.Env[Any, Any]:
        from gymnasium.envs.classic_control.pendulum import PendulumEnv
        from gymnasium.wrappers import RescaleAction, TimeLimit

        simulator = PendulumEnv(g=parameters["gravity"])
        simulator.m, simulator.l = parameters["mass"], parameters["length"]
        in_unit_range = RescaleAction(simulator, np.float32(-1.0), np.float32(1.0))
        return TimeLimit(in_unit_range, self.settings.horizon)

    def camera(
        self, task: gymnasium.Env[Any, Any], parameters: Parameters, *, width: int, height: int
    ) -> "PendulumCamera":
        return PendulumCamera(parameters["length"], width, height)

    def fingerprint(self) -> dict[str, Any]:
        return {"versions": {"gymnasium": version("gymnasium")}}


@final
class PendulumCamera(FigureCamera):
    """Draws the rod from the pivot to its end.

    Args:
        length: of the rod in m.
        width: of the picture in pixels.
        height: of the picture in pixels.
    """

    def __init__(self, length: float, width: int, height: int) -> None:
        super().__init__(width, height)
        self._length, self._shape = length, height / width

    def draw(self, axes: "Axes", observations: FloatArray) -> None:
        cosine, sine, _ = observations[-1]  # of the angle from upright
        axes.plot([0.0, -self._length * sine], [0.0, self._length * cosine], "o-", linewidth=5)
        reach = 1.2 * self._length / self._shape
        axes.set(xlim=(-reach, reach), ylim=(-1.2 * self._length, 1.2 * self._length))
