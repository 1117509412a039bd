"""Base class of tasks simulated by MuJoCo, and the fingerprint of their physics."""

import abc
import hashlib
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np

from tcmrl_data.envs._simulation_camera import SimulationCamera, Viewpoint
from tcmrl_data.envs.trajectory import FloatArray


class SimulatedTask(gymnasium.Env[FloatArray, FloatArray]):
    """One task, run by a simulator of another library.

    Actions are clipped to [-1, 1] and episodes are truncated at the horizon. An episode depends only on the
    seed of its reset and its actions, not on earlier episodes.
    """

    def __init__(
        self, simulator: gymnasium.Env[Any, Any], *, horizon: int, observation_dim: int, action_dim: int
    ) -> None:
        self._simulator = simulator
        self._horizon = horizon
        self._steps = 0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observation_dim,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (action_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        observation, _ = self._simulator.reset(seed=seed)
        return self.observe(observation), {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        executed = np.clip(action, -1.0, 1.0)
        observation, reward, terminated, _, info = self._simulator.step(executed)
        self._steps += 1
        reward = self.reward(executed, float(reward), info)
        truncated = self._steps >= self._horizon
        return self.observe(observation), reward, bool(terminated), truncated, self.extras(info)

    def close(self) -> None:
        self._simulator.close()

    def camera(self, viewpoint: str | Viewpoint, *, width: int, height: int) -> SimulationCamera:
        """A camera in the simulated world.

        Args:
            viewpoint: name of one of the model's cameras, or a place.
            width: of the pictures in pixels.
            height: of the pictures in pixels.

        Raises:
            RenderingError: no OpenGL works on this machine.
        """
        simulator: Any = self._simulator
        return SimulationCamera(
            simulator.model, simulator.data, width=width, height=height, viewpoint=viewpoint
        )

    def observe(self, observation: FloatArray) -> FloatArray:
        """The task's observation for the simulator's observation, both (observation_dim,)."""
        return observation

    @abc.abstractmethod
    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        """The task's reward for an executed action (action_dim,), given the simulator's reward and info."""

    def extras(self, info: dict[str, Any]) -> dict[str, Any]:
        """The extra values of a step, given the simulator's info."""
        return {}


def squared_norm(action: FloatArray) -> float:
    """|a|^2 in double precision."""
    return float(np.square(action, dtype=np.float64).sum())


def simulation_fingerprint(simulator: Any, *packages: str) -> dict[str, Any]:
    """Everything other than the task that a simulator's dynamics depend on.

    Args:
        simulator: a Gymnasium MuJoCo environment, before a task is applied to its model.
        packages: distributions that define the dynamics, in addition to mujoco and gymnasium.

    Returns:
        JSON values: seconds per physics step and per action, physics steps per action, sha256 of the compiled
        model in MuJoCo's binary format, and package versions.
    """
    import mujoco

    model = simulator.model
    binary = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, binary)
    return {
        "timestep": float(model.opt.timestep),
        "frame_skip": int(simulator.frame_skip),
        "dt": float(simulator.dt),
        "model_sha256": hashlib.sha256(binary.tobytes()).hexdigest(),
        "versions": {name: version(name) for name in sorted({"mujoco", "gymnasium", *packages})},
    }
