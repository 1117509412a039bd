"""Cameras: pictures of a task while an episode is played."""

import abc
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Picture = npt.NDArray[np.uint8]
"""(height, width, 3), red, green and blue."""

FIGURE_WIDTH = 3.2
"""Width of a figure in inches; a wider picture shows the same at a higher resolution."""


class Camera(abc.ABC):
    """Takes pictures of one task; it changes neither the task nor its random numbers."""

    @abc.abstractmethod
    def picture(self, observations: FloatArray) -> Picture:
        """The task as it is now.

        Args:
            observations: (t + 1, observation_dim), full view, of the episode up to now.
        """

    def close(self) -> None:
        """Frees what the camera holds; does nothing by default."""


class FigureCamera(Camera):
    """Base class of cameras that draw what they see of the observations with matplotlib.

    Args:
        width: of the picture in pixels.
        height: of the picture in pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        dpi = width / FIGURE_WIDTH
        self._canvas = FigureCanvasAgg(Figure(figsize=(FIGURE_WIDTH, height / dpi), dpi=dpi))
        self._axes = self._canvas.figure.add_axes((0.0, 0.0, 1.0, 1.0))

    @abc.abstractmethod
    def draw(self, axes: "Axes", observations: FloatArray) -> None:
        """Draws the task on empty axes that fill the picture and have no frame.

        Args:
            axes: where to draw; the method sets their limits.
            observations: as for `picture`.
        """

    def picture(self, observations: FloatArray) -> Picture:
        self._axes.clear()
        self._axes.set_axis_off()
        self.draw(self._axes, observations)
        canvas: Any = self._canvas  # matplotlib's types leave these methods out
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
