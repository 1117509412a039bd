"""Half-Cheetah-Dir: a planar cheetah runs forward or backward.

The definition follows MAML and PEARL, with Gymnasium's HalfCheetah-v5 model: the reward is s v - 0.05 |a|^2,
where s is 1 or -1 and v the torso's forward velocity over the step; dt is 0.05; episodes do not terminate.
Observations are Gymnasium's, 17 values without the absolute x, which PEARL, FOCAL, IDAQ and TCMRL have: later
in an episode x alone shows in which direction the behavior policy ran.

There are two directions only, so that test tasks repeat the parameters of training tasks. Results say whether
a method recognizes the direction; they say nothing about generalization to other tasks.
"""

from typing import Any, final

import gymnasium
from pydantic import Field

from tcmrl_data.envs._simulation import SimulatedTask, simulation_fingerprint, squared_norm
from tcmrl_data.envs.base import Environment, EnvironmentSettings, Parameters, Reward
from tcmrl_data.envs.camera import Camera
from tcmrl_data.envs.controller import View
from tcmrl_data.envs.trajectory import FloatArray

DIRECTIONS = (-1.0, 1.0)


class HalfCheetahDirSettings(EnvironmentSettings):
    """Settings of Half-Cheetah-Dir.

    Attributes:
        control_cost: weight of |a|^2 (published code: 0.05).
    """

    control_cost: float = Field(default=0.05, ge=0)


@final
class HalfCheetahDir(Environment):
    """Directions -1, 1, -1, 1, …; dense reward; episodes end at the horizon only."""

    name = "half-cheetah-dir"
    Settings = HalfCheetahDirSettings
    observation_dim = 17
    action_dim = 6
    ordering_name = "direction"
    simulator_bytes = 2 * 2**20
    settings: HalfCheetahDirSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        return [{"direction": DIRECTIONS[index % len(DIRECTIONS)]} for index in range(num_tasks)]

    def ordering(self, parameters: Parameters) -> float:
        return float(parameters["direction"])

    def make(
        self, parameters: Parameters, *, view: View = "stored", reward: Reward = "stored"
    ) -> "HalfCheetahDirTask":
        return HalfCheetahDirTask(float(parameters["direction"]), self.settings)

    def camera(
        self, task: gymnasium.Env[Any, Any], parameters: Parameters, *, width: int, height: int
    ) -> Camera:
        assert isinstance(task, HalfCheetahDirTask)
        return task.camera("track", width=width, height=height)

    def fingerprint(self) -> dict[str, Any]:
        simulator = _simulator()
        try:
            return simulation_fingerprint(simulator) | {"observation": "qpos without x, qvel"}
        finally:
            simulator.close()


@final
class HalfCheetahDirTask(SimulatedTask):
    """The cheetah with one direction: 1 for forward, -1 for backward."""

    def __init__(self, direction: float, settings: HalfCheetahDirSettings) -> None:
        super().__init__(
            _simulator(),
            horizon=settings.horizon,
            observation_dim=HalfCheetahDir.observation_dim,
            action_dim=HalfCheetahDir.action_dim,
        )
        self._direction, self._control_cost = direction, settings.control_cost

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        return self._direction * float(info["x_velocity"]) - self._control_cost * squared_norm(action)


def _simulator() -> Any:
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    return HalfCheetahEnv()
