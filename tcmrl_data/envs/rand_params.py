"""Hopper- and Walker-Rand-Params: run forward with a body whose physics depend on the task.

A task multiplies every element of the nominal body masses, inertias, joint dampings and friction
coefficients by base^U(-3, 3). The models are Gymnasium's Hopper-v5 and Walker2d-v5 (both feet of the walker
have friction 1.9). Two settings concern differences from the older models of the published code:

- Physics step. An action lasts 4 steps of 0.004 s in the older models and 4 steps of 0.002 s in Gymnasium's.
  The default is 0.004 s, for which horizon and returns were published; with random actions all tasks stayed
  finite.
- Derived constants. MuJoCo stores quantities computed from masses (inverse weights, which set the stiffness
  of contacts and joint limits). By default `mj_setConst` recomputes them for the scaled body; the published
  code keeps the values of the nominal body.
"""

import abc
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from tcmrl_data.envs.base import EnvironmentSettings, ObservationView, Parameters, Reward
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.envs.simulation import SimulatedEnvironment, SimulatedTask, squared_norm
from tcmrl_data.foundation.errors import TaskError

ALIVE_BONUS = 1.0
CONTROL_COST = 1e-3


class RandParamsSettings(EnvironmentSettings):
    """Settings of the randomised bodies.

    Attributes:
        multiplier_base: base of the multipliers of mass, inertia and friction (paper, Appendix D: 1.5).
        damping_base: base of the damping multipliers (paper, Appendix D: 1.5; published code: 1.3).
        log_scale_limit: exponents are uniform in [-limit, limit] (paper, Appendix D: 3).
        timestep: seconds per physics step; an action lasts four steps (models of the published code: 0.004,
            Gymnasium's: 0.002).
        constants: derived constants, `recomputed` by mj_setConst after scaling, or `nominal` as in the
            published code.
    """

    multiplier_base: float = Field(default=1.5, gt=1)
    damping_base: float = Field(default=1.5, gt=1)
    log_scale_limit: float = Field(default=3.0, ge=0)
    timestep: float = Field(default=0.004, gt=0, le=0.01)
    constants: Literal["recomputed", "nominal"] = "recomputed"


class _RandParams(SimulatedEnvironment):
    """Base class of both robots; `shapes` lists the scaled model arrays in the order of drawing."""

    Settings = RandParamsSettings
    settings: RandParamsSettings
    shapes: ClassVar[Mapping[str, tuple[int, ...]]]

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        random = np.random.RandomState(task_seed)  # the published code's generator
        return [self._draw(random) for _ in range(num_tasks)]

    def _draw(self, random: np.random.RandomState) -> dict[str, Any]:
        settings, limit = self.settings, self.settings.log_scale_limit
        multipliers: dict[str, Any] = {}
        for name, shape in self.shapes.items():
            base = settings.damping_base if name == "dof_damping" else settings.multiplier_base
            exponents = random.uniform(-limit, limit, shape)
            # NumPy's power of an array rounds differently with AVX-512
            powers = [math.pow(base, exponent) for exponent in exponents.ravel()]
            multipliers[name] = np.reshape(powers, shape).tolist()
        return multipliers

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> "RandParamsTask":
        simulator = self.simulator()
        self._scale(simulator, parameters)
        return RandParamsTask(self, simulator)

    def simulator(self) -> Any:
        simulator = self.body()
        simulator.model.opt.timestep = self.settings.timestep
        return simulator

    def _scale(self, simulator: Any, parameters: Parameters) -> None:
        for name, shape in self.shapes.items():
            multipliers = np.asarray(parameters[name], dtype=np.float64)
            if multipliers.shape != shape:
                raise TaskError(f"{self.name}: {name} has shape {multipliers.shape}, the model needs {shape}")
            array = getattr(simulator.model, name)
            array[:] = array.copy() * multipliers
        if self.settings.constants == "recomputed":
            import mujoco

            mujoco.mj_setConst(simulator.model, simulator.data)

    def fingerprint(self) -> dict[str, Any]:
        return super().fingerprint() | {"constants": self.settings.constants}

    @abc.abstractmethod
    def body(self) -> Any:
        """Makes Gymnasium's environment with the nominal body."""


@final
class HopperRandParams(_RandParams):
    """One leg; terminates unless the torso is above 0.7 m and leans by less than 0.2 rad."""

    name = "hopper-rand-params"
    observation_dim = 11
    action_dim = 3
    shapes: ClassVar = {
        "body_mass": (5,),
        "body_inertia": (5, 3),
        "dof_damping": (6,),
        "geom_friction": (5, 3),
    }

    def body(self) -> Any:
        from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

        return HopperEnv()


@final
class WalkerRandParams(_RandParams):
    """Two legs; terminates unless the torso's height is in (0.8, 2) m and it leans by less than 1 rad."""

    name = "walker-rand-params"
    observation_dim = 17
    action_dim = 6
    shapes: ClassVar = {
        "body_mass": (8,),
        "body_inertia": (8, 3),
        "dof_damping": (9,),
        "geom_friction": (8, 3),
    }

    def body(self) -> Any:
        from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

        return Walker2dEnv()


@final
class RandParamsTask(SimulatedTask):
    """One task: the reward is v + 1 - 0.001 |a|^2, where v is the torso's forward velocity over the step.

    The terminating step receives the bonus of 1 too, as in the published code; Gymnasium's v5 omits it.
    """

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        return float(info["x_velocity"]) + ALIVE_BONUS - CONTROL_COST * squared_norm(action)
