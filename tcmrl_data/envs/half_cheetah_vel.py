"""Half-Cheetah-Vel: a planar cheetah runs at a target velocity.

The definition follows MAML, PEARL and FOCAL, with Gymnasium's HalfCheetah-v5 model: the reward is
-|v - v*| - 0.05 |a|^2, where v is the torso's forward velocity over the step; dt is 0.05; episodes do not
terminate. Observations are Gymnasium's, 17 values without the absolute x; FOCAL and CSRO add the torso's
position.
"""

from typing import Any, final

import gymnasium
import numpy as np
from pydantic import Field, model_validator

from tcmrl_data.envs._simulation import SimulatedTask, simulation_fingerprint, squared_norm
from tcmrl_data.envs.base import Environment, EnvironmentSettings, Parameters, Reward
from tcmrl_data.envs.camera import Camera
from tcmrl_data.envs.controller import View
from tcmrl_data.envs.trajectory import FloatArray


class HalfCheetahVelSettings(EnvironmentSettings):
    """Settings of Half-Cheetah-Vel.

    Attributes:
        min_velocity: smallest target velocity in m/s (published code of FOCAL, IDAQ, TCMRL: 0; CSRO: 1).
        max_velocity: largest target velocity in m/s (published code: 3).
        control_cost: weight of |a|^2 (published code: 0.05).
    """

    min_velocity: float = Field(default=0.0, ge=0)
    max_velocity: float = Field(default=3.0, gt=0)
    control_cost: float = Field(default=0.05, ge=0)

    @model_validator(mode="after")
    def _velocities_span(self) -> "HalfCheetahVelSettings":
        if self.min_velocity >= self.max_velocity:
            raise ValueError(
                f"min_velocity ({self.min_velocity}) must be below max_velocity ({self.max_velocity})"
            )
        return self


@final
class HalfCheetahVel(Environment):
    """Target velocities drawn uniformly; dense reward; episodes end at the horizon only."""

    name = "half-cheetah-vel"
    Settings = HalfCheetahVelSettings
    observation_dim = 17
    action_dim = 6
    ordering_name = "velocity (m/s)"
    simulator_bytes = 2 * 2**20
    settings: HalfCheetahVelSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        random = np.random.RandomState(task_seed)  # the published code's generator
        low, high = self.settings.min_velocity, self.settings.max_velocity
        return [{"velocity": float(velocity)} for velocity in random.uniform(low, high, num_tasks)]

    def ordering(self, parameters: Parameters) -> float:
        return float(parameters["velocity"])

    def make(
        self, parameters: Parameters, *, view: View = "stored", reward: Reward = "stored"
    ) -> "HalfCheetahVelTask":
        return HalfCheetahVelTask(float(parameters["velocity"]), self.settings)

    def camera(
        self, task: gymnasium.Env[Any, Any], parameters: Parameters, *, width: int, height: int
    ) -> Camera:
        assert isinstance(task, HalfCheetahVelTask)
        return task.camera("track", width=width, height=height)

    def fingerprint(self) -> dict[str, Any]:
        simulator = _simulator()
        try:
            return simulation_fingerprint(simulator) | {"observation": "qpos without x, qvel"}
        finally:
            simulator.close()


@final
class HalfCheetahVelTask(SimulatedTask):
    """The cheetah with one target velocity."""

    def __init__(self, velocity: float, settings: HalfCheetahVelSettings) -> None:
        super().__init__(
            _simulator(),
            horizon=settings.horizon,
            observation_dim=HalfCheetahVel.observation_dim,
            action_dim=HalfCheetahVel.action_dim,
        )
        self._velocity, self._control_cost = velocity, settings.control_cost

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        miss = abs(float(info["x_velocity"]) - self._velocity)
        return -miss - self._control_cost * squared_norm(action)


def _simulator() -> Any:
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    return HalfCheetahEnv()
