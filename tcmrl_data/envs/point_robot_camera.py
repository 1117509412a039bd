"""The plane of the point robots as it is drawn: start, goal, wind and path."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, final

import numpy as np

from tcmrl_data.envs.camera import FigureCamera
from tcmrl_data.envs.trajectory import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CENTER, WIDTH = (0.0, 0.4), 2.7
"""What a picture shows at least: the half circle of goals with some room."""

WIND_AT, WIND_SCALE = (-0.9, 1.0), 6.0
"""Where the wind's arrow starts, and how many times it is longer than the wind."""


@final
class PointRobotCamera(FigureCamera):
    """Draws the plane of one task.

    Args:
        parameters: goal and wind of the task.
        reward_radius: distance to the goal within which there is a reward; None if it is everywhere.
        width: of the picture in pixels.
        height: of the picture in pixels.
    """

    def __init__(
        self, parameters: Mapping[str, Any], *, reward_radius: float | None, width: int, height: int
    ) -> None:
        super().__init__(width, height)
        self._parameters, self._radius, self._shape = parameters, reward_radius, height / width

    def draw(self, axes: "Axes", observations: FloatArray) -> None:
        draw_task(axes, self._parameters, reward_radius=self._radius)
        axes.plot(observations[:, 0], observations[:, 1], ".-", color="tab:blue", markersize=3, linewidth=1)
        axes.plot(*observations[-1], "o", color="tab:blue", markersize=6)
        farthest = np.abs((observations - CENTER) / (1.0, self._shape)).max()
        half = max(WIDTH / 2, 1.05 * float(farthest))
        axes.set_xlim(CENTER[0] - half, CENTER[0] + half)
        axes.set_ylim(CENTER[1] - self._shape * half, CENTER[1] + self._shape * half)


def draw_task(
    axes: "Axes", parameters: Mapping[str, Any], *, reward_radius: float | None, color: str = "tab:green"
) -> None:
    """Draws start, goal and wind of a task, and the half circle if the goal lies on it.

    Args:
        axes: where to draw.
        parameters: goal and wind of the task.
        reward_radius: as of `PointRobotCamera`.
        color: of the goal.
    """
    from matplotlib.patches import Circle

    goal, wind = np.array(parameters["goal"]), np.array(parameters["wind"])
    if not wind.any():
        angles = np.linspace(0.0, np.pi, 100)
        axes.plot(np.cos(angles), np.sin(angles), ":", color="0.7", linewidth=1)
    if reward_radius is not None:
        axes.add_patch(Circle((goal[0], goal[1]), reward_radius, color=color, alpha=0.2, linewidth=0))
    axes.plot(0.0, 0.0, "+", color="0.3", markersize=8)
    axes.plot(*goal, "*", color=color, markersize=11)
    if wind.any():
        arrow = {"arrowstyle": "->", "color": "tab:red", "linewidth": 1.5}
        x, y = WIND_AT + WIND_SCALE * wind
        axes.annotate("", (x, y), WIND_AT, arrowprops=arrow)
        side = "right" if wind[0] > 0 else "left"
        axes.text(*WIND_AT, " wind ", color="tab:red", fontsize=8, ha=side, va="center")
