"""Base classes of environments and tasks simulated by MuJoCo: their loop, fingerprint and camera."""

import abc
import functools
import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from typing import Any, ClassVar, final

import gymnasium
import numpy as np

from tcmrl_data.envs.base import Camera, Environment, Parameters, Picture
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.foundation.errors import RenderingError

OPEN_GL = ("egl", "osmesa")
"""Kinds of OpenGL that need no screen: by the graphics driver, or by Mesa on the processor."""

TRIAL_SECONDS = 60.0
TRIAL = """
import sys
from importlib import import_module
import mujoco
context = import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100).free()
context.free()
"""
REMEDY = "install libegl1 and libgl1-mesa-dri, or libosmesa6, or draw on another machine"


@dataclass(frozen=True)
class Viewpoint:
    """Where a free camera stands.

    Attributes:
        look_at: point in the middle of the picture, in m.
        distance: distance from that point in m.
        azimuth: viewing direction around the vertical axis in degrees; 90 looks along y.
        elevation: viewing direction in degrees above the horizon; negative looks down.
    """

    look_at: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float


class SimulatedEnvironment(Environment):
    """Base class of environments whose tasks are `SimulatedTask`s."""

    simulator_bytes = 2 * 2**20
    viewpoint: ClassVar[str | Viewpoint] = "track"
    """Where the camera stands: name of one of the model's cameras, or a place."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Distributions that define the dynamics, in addition to mujoco and gymnasium."""
    physics: ClassVar[dict[str, Any]] = {}
    """Further JSON values of the fingerprint."""

    @abc.abstractmethod
    def simulator(self) -> Any:
        """Makes the Gymnasium environment of MuJoCo, before a task is applied to it."""

    def camera(
        self, task: gymnasium.Env[Any, Any], parameters: Parameters, *, width: int, height: int
    ) -> Camera:
        assert isinstance(task, SimulatedTask)
        return task.camera(self.viewpoint, width=width, height=height)

    def fingerprint(self) -> dict[str, Any]:
        """Seconds per physics step and per action, the model's sha256 in MuJoCo's binary format, versions."""
        import mujoco

        simulator = self.simulator()
        try:
            model = simulator.model
            binary = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
            mujoco.mj_saveModel(model, None, binary)
            return {
                "timestep": float(model.opt.timestep),
                "frame_skip": int(simulator.frame_skip),
                "dt": float(simulator.dt),
                "model_sha256": hashlib.sha256(binary.tobytes()).hexdigest(),
                "versions": {name: version(name) for name in sorted({"mujoco", "gymnasium", *self.packages})},
            } | self.physics
        finally:
            simulator.close()


class SimulatedTask(gymnasium.Env[FloatArray, FloatArray]):
    """One task, run by a simulator to which the task has been applied.

    Actions are clipped to [-1, 1] and episodes are truncated at the horizon. An episode depends only on the
    seed of its reset and its actions, not on earlier episodes.
    """

    def __init__(self, environment: Environment, simulator: gymnasium.Env[Any, Any]) -> None:
        self._simulator = simulator
        self._horizon, self._steps = environment.settings.horizon, 0
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (environment.observation_dim,), np.float64
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (environment.action_dim,), np.float32)

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

    def camera(self, viewpoint: str | Viewpoint, *, width: int, height: int) -> Camera:
        """A camera at one of the model's cameras or at a given place; width and height are in pixels."""
        simulator: Any = self._simulator
        return _SimulationCamera(
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


@final
class _SimulationCamera(Camera):
    """MuJoCo's renderer with the first kind of OpenGL that works without a screen."""

    def __init__(self, model: Any, data: Any, *, width: int, height: int, viewpoint: str | Viewpoint) -> None:
        import mujoco

        kind = find_open_gl()
        if kind is None:
            raise RenderingError(
                f"no OpenGL works here without a screen (EGL, OSMesa), so that MuJoCo cannot draw; {REMEDY}"
            )
        # MuJoCo chooses at its import, by MUJOCO_GL, and has been imported to make the task
        gl: Any = import_module("mujoco.gl_context")
        gl.GLContext = import_module(f"mujoco.{kind}").GLContext
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._data, self._renderer = data, mujoco.Renderer(model, height, width)
        self._view: Any = viewpoint
        if isinstance(viewpoint, Viewpoint):
            self._view = mujoco.MjvCamera()
            self._view.lookat[:] = viewpoint.look_at
            self._view.distance, self._view.azimuth = viewpoint.distance, viewpoint.azimuth
            self._view.elevation = viewpoint.elevation

    def picture(self, observations: FloatArray) -> Picture:
        self._renderer.update_scene(self._data, self._view)
        picture: Picture = self._renderer.render()
        return picture

    def close(self) -> None:
        self._renderer.close()


def check_chosen_open_gl() -> None:
    """Raises `RenderingError` if the kind in `MUJOCO_GL` does not work here; MuJoCo fails at its import."""
    named = os.environ.get("MUJOCO_GL", "")
    if named.lower() in OPEN_GL and find_open_gl() is None:
        raise RenderingError(f"MUJOCO_GL={named} does not work here, so that MuJoCo cannot draw; {REMEDY}")


@functools.cache
def find_open_gl() -> str | None:
    """The first kind of OpenGL that works here, or None; only the one in `MUJOCO_GL`, if it names one.

    Each kind is tried in a new process: a process cannot change the kind that it has loaded, and a broken
    driver may end it. Other values of `MUJOCO_GL`, such as `disabled`, are ignored.
    """
    named = os.environ.get("MUJOCO_GL", "").lower()
    return next((kind for kind in ((named,) if named in OPEN_GL else OPEN_GL) if _works(kind)), None)


def _works(kind: str) -> bool:
    command, own = [sys.executable, "-c", TRIAL, kind], os.environ | {"MUJOCO_GL": kind}
    try:
        trial = subprocess.run(command, env=own, capture_output=True, check=False, timeout=TRIAL_SECONDS)
    except subprocess.TimeoutExpired:
        return False
    return trial.returncode == 0
