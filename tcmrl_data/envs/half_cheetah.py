"""Half-Cheetah-Vel and Half-Cheetah-Dir: a planar cheetah runs at a target velocity, or forward or backward.

Both use Gymnasium's HalfCheetah-v5 model; v is the torso's forward velocity over a step of 0.05 s; episodes
do not terminate. Observations are Gymnasium's, 17 values without the absolute x.

Half-Cheetah-Vel follows MAML, PEARL and FOCAL: the reward is -|v - v*| - 0.05 |a|^2. FOCAL and CSRO add the
torso's position to observations.

Half-Cheetah-Dir follows MAML and PEARL: the reward is s v - 0.05 |a|^2, where s is 1 or -1. PEARL, FOCAL,
IDAQ and TCMRL observe the absolute x, which is left out here: later in an episode x alone shows in which
direction the behavior policy ran. There are two directions only, so that test tasks repeat the parameters of
training tasks. Results say whether a method recognizes the direction; they say nothing about generalization
to other tasks.
"""

import abc
from typing import Any, ClassVar, final

import numpy as np
from pydantic import Field, model_validator

from tcmrl_data.envs.base import EnvironmentSettings, ObservationView, Parameters, Reward
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.envs.simulation import SimulatedEnvironment, SimulatedTask, squared_norm

DIRECTIONS = (-1.0, 1.0)


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


class HalfCheetahDirSettings(EnvironmentSettings):
    """Settings of Half-Cheetah-Dir.

    Attributes:
        control_cost: weight of |a|^2 (published code: 0.05).
    """

    control_cost: float = Field(default=0.05, ge=0)


class _HalfCheetah(SimulatedEnvironment):
    """Base class of both: the reward is a function of the velocity minus the control cost."""

    observation_dim = 17
    action_dim = 6
    physics: ClassVar = {"observation": "qpos without x, qvel"}
    settings: HalfCheetahVelSettings | HalfCheetahDirSettings

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> "HalfCheetahTask":
        return HalfCheetahTask(self, parameters)

    def simulator(self) -> Any:
        from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

        return HalfCheetahEnv()

    @abc.abstractmethod
    def velocity_reward(self, velocity: float, parameters: Parameters) -> float:
        """The reward of a step with a forward velocity in m/s, without the control cost."""


@final
class HalfCheetahTask(SimulatedTask):
    """The cheetah with one target velocity or direction."""

    def __init__(self, environment: _HalfCheetah, parameters: Parameters) -> None:
        super().__init__(environment, environment.simulator())
        self._environment, self._parameters = environment, parameters

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        reward = self._environment.velocity_reward(float(info["x_velocity"]), self._parameters)
        return reward - self._environment.settings.control_cost * squared_norm(action)


@final
class HalfCheetahVel(_HalfCheetah):
    """Target velocities drawn uniformly; dense reward; episodes end at the horizon only."""

    name = "half-cheetah-vel"
    Settings = HalfCheetahVelSettings
    ordering_name = "velocity (m/s)"
    settings: HalfCheetahVelSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        random = np.random.RandomState(task_seed)  # the published code's generator
        low, high = self.settings.min_velocity, self.settings.max_velocity
        return [{"velocity": float(velocity)} for velocity in random.uniform(low, high, num_tasks)]

    def ordering(self, parameters: Parameters) -> float:
        return float(parameters["velocity"])

    def velocity_reward(self, velocity: float, parameters: Parameters) -> float:
        return -abs(velocity - float(parameters["velocity"]))


@final
class HalfCheetahDir(_HalfCheetah):
    """Directions -1 (backward), 1, -1, 1, …; dense reward; episodes end at the horizon only."""

    name = "half-cheetah-dir"
    Settings = HalfCheetahDirSettings
    ordering_name = "direction"
    settings: HalfCheetahDirSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        return [{"direction": DIRECTIONS[index % len(DIRECTIONS)]} for index in range(num_tasks)]

    def ordering(self, parameters: Parameters) -> float:
        return float(parameters["direction"])

    def velocity_reward(self, velocity: float, parameters: Parameters) -> float:
        return float(parameters["direction"]) * velocity
