"""A camera for tasks that MuJoCo simulates."""

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from tcmrl_data.envs._open_gl import make_context
from tcmrl_data.envs.camera import Camera, Picture
from tcmrl_data.envs.trajectory import FloatArray

MAX_GEOMS = 10_000


@dataclass(frozen=True)
class Viewpoint:
    """Where a free camera stands.

    Attributes:
        look_at: point in the middle of the picture, in m.
        distance: from that point, in m.
        azimuth: direction of the look around the vertical axis, in degrees; 90 looks along y.
        elevation: of the look, in degrees; negative looks down.
    """

    look_at: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float


@final
class SimulationCamera(Camera):
    """Draws the state of a MuJoCo simulation with OpenGL.

    Args:
        model: MuJoCo's model; only its picture buffer is changed.
        data: MuJoCo's data, which are read.
        width: of the picture in pixels.
        height: of the picture in pixels.
        viewpoint: name of one of the model's cameras, or a place.

    Raises:
        RenderingError: no OpenGL works on this machine.
    """

    def __init__(self, model: Any, data: Any, *, width: int, height: int, viewpoint: str | Viewpoint) -> None:
        import mujoco

        self._gl = make_context(width, height)
        self._model, self._data = model, data
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._pictures = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._pictures)
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._view = _view(model, viewpoint)

    def picture(self, observations: FloatArray) -> Picture:
        import mujoco

        self._gl.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL
        nothing = mujoco.MjvPerturb()
        mujoco.mjv_updateScene(
            self._model, self._data, mujoco.MjvOption(), nothing, self._view, every, self._scene
        )
        mujoco.mjr_render(self._rectangle, self._scene, self._pictures)
        upside_down = np.empty((self._rectangle.height, self._rectangle.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(upside_down, None, self._rectangle, self._pictures)
        return np.flipud(upside_down)

    def close(self) -> None:
        self._gl.make_current()
        self._pictures.free()
        self._gl.free()  # by the garbage collector at exit, it would print tracebacks


def _view(model: Any, viewpoint: str | Viewpoint) -> Any:
    import mujoco

    view = mujoco.MjvCamera()
    if isinstance(viewpoint, str):
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = model.camera(viewpoint).id
        return view
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.lookat[:] = viewpoint.look_at
    view.distance, view.azimuth, view.elevation = viewpoint.distance, viewpoint.azimuth, viewpoint.elevation
    return view
