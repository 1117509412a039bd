"""Point robots in the plane, with a goal on the half circle (dense or sparse reward) or with a wind.

The definitions follow the published code of PEARL, FOCAL and IDAQ. The robot starts at the origin, and an
action moves it by at most 0.1 per axis.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, final

import gymnasium
import numpy as np
import numpy.typing as npt
from pydantic import Field

from tcmrl_data.envs.base import (
    DENSE_REWARDS,
    Camera,
    Controller,
    Environment,
    EnvironmentSettings,
    FigureCamera,
    Lanes,
    LaneStep,
    ObservationView,
    Parameters,
    Reward,
)
from tcmrl_data.envs.rollout import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEP_SIZE = 0.1

CENTER, WIDTH = (0.0, 0.4), 2.7
"""The smallest part of the plane that a picture shows: the half circle of goals and a margin."""

WIND_AT, WIND_SCALE = (-0.9, 1.0), 6.0
"""Start of the wind's arrow, and its length divided by the wind's."""


class PointRobotSettings(EnvironmentSettings):
    """Settings of the point robots.

    Attributes:
        goal_radius: largest distance with a sparse reward (published code: 0.2).
        sparse_reward: the reward inside the radius is 1 - dist with `distance` (paper, Appendix D) and
            1 - dist / radius with `normalized` (published code).
        wind_limit: the wind is uniform in [-limit, limit] per axis (published code: 0.05).
    """

    goal_radius: float = Field(default=0.2, gt=0)
    sparse_reward: Literal["distance", "normalized"] = "distance"
    wind_limit: float = Field(default=0.05, ge=0)


class SparsePointRobotSettings(PointRobotSettings):
    """Settings of the point robot with sparse rewards.

    Attributes:
        dense_rewards: parts also store -dist of every step, as the array `dense_rewards`. The published code
            of IDAQ and TCMRL trains the actor-critic on them, and only the context on sparse rewards.
    """

    dense_rewards: bool = False


class _PointRobot(Environment):
    """Base class of the point robots: planar motion, stepped as one NumPy batch."""

    Settings = PointRobotSettings
    observation_dim = 2
    action_dim = 2
    plane = ("x", "y")
    settings: PointRobotSettings

    def rewards(self, distances: FloatArray, reward: Reward) -> FloatArray:
        """Rewards (...) for distances (...) to the goal after the step."""
        return -distances

    def extra_arrays(self, distances: FloatArray) -> dict[str, npt.NDArray[np.generic]]:
        """The extra arrays of a step that ends at distances (lanes,) to the goal."""
        return {}

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> "PointRobotEnv":
        return PointRobotEnv(PointRobotLanes(self, [parameters], reward))

    def lanes(self, parameters: Sequence[Parameters], *, reward: Reward = "stored") -> "PointRobotLanes":
        return PointRobotLanes(self, parameters, reward)

    def camera(
        self, task: gymnasium.Env[Any, Any], parameters: Parameters, *, width: int, height: int
    ) -> Camera:
        return PointRobotCamera(parameters, reward_radius=self._reward_radius, width=width, height=height)

    def draw_path(
        self, axes: "Axes", parameters: Parameters, observations: FloatArray, *, color: str
    ) -> None:
        draw_task(axes, parameters, reward_radius=self._reward_radius, color=color)
        axes.plot(observations[:, 0], observations[:, 1], ".-", color=color, markersize=3, linewidth=1)
        axes.set_aspect("equal")

    @property
    def _reward_radius(self) -> float | None:
        return self.settings.goal_radius if self.settings.reward_density == "sparse" else None

    def oracle(self, parameters: Sequence[Parameters]) -> "GreedyController":
        return GreedyController(*goals_and_winds(parameters))


class _HalfCircleRobot(_PointRobot):
    """Goals (cos a, sin a) at angles a evenly spaced from 0 to pi, without wind."""

    ordering_name = "goal angle (rad)"

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        angles = np.linspace(0.0, np.pi, num_tasks)
        return [{"goal": [math.cos(angle), math.sin(angle)], "wind": [0.0, 0.0]} for angle in angles]

    def ordering(self, parameters: Parameters) -> float:
        x, y = parameters["goal"]
        return math.atan2(y, x)


@final
class PointRobot(_HalfCircleRobot):
    """Goals on the half circle; dense reward -dist."""

    name = "point-robot"


@final
class SparsePointRobot(_HalfCircleRobot):
    """Goals on the half circle; a reward only near the goal."""

    name = "sparse-point-robot"
    Settings = SparsePointRobotSettings
    settings: SparsePointRobotSettings

    def __init__(self, settings: EnvironmentSettings) -> None:
        super().__init__(settings)
        if self.settings.dense_rewards:
            # a class attribute elsewhere; here the recipe decides
            self.extras = {DENSE_REWARDS: np.float32}  # type: ignore[misc]

    def rewards(self, distances: FloatArray, reward: Reward) -> FloatArray:
        if reward == "dense":
            return -distances
        radius = self.settings.goal_radius
        scale = radius if self.settings.sparse_reward == "normalized" else 1.0
        return np.where(distances <= radius, 1.0 - distances / scale, 0.0)

    def extra_arrays(self, distances: FloatArray) -> dict[str, npt.NDArray[np.generic]]:
        return {name: (-distances).astype(kind) for name, kind in self.extras.items()}


@final
class PointRobotWind(_PointRobot):
    """One goal at (1, 0); a task has a constant wind, which is added to every step."""

    name = "point-robot-wind"

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        random = np.random.RandomState(task_seed)  # as the published code: all x first, then all y
        limit = self.settings.wind_limit
        winds = [random.uniform(-limit, limit, num_tasks) for _ in range(2)]
        return [{"goal": [1.0, 0.0], "wind": [float(x), float(y)]} for x, y in zip(*winds, strict=True)]


def goals_and_winds(parameters: Sequence[Parameters]) -> tuple[FloatArray, FloatArray]:
    """Goals (tasks, 2) and winds (tasks, 2) of several tasks."""
    return (
        np.array([task["goal"] for task in parameters], dtype=np.float64),
        np.array([task["wind"] for task in parameters], dtype=np.float64),
    )


@final
class GreedyController(Controller):
    """Moves towards the goal as far as one step allows on every axis, against the wind; without noise."""

    def __init__(self, goals: FloatArray, winds: FloatArray) -> None:
        self._targets = goals - winds

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        return np.clip((self._targets - observations) / STEP_SIZE, -1.0, 1.0)


@final
class PointRobotLanes(Lanes):
    """Point robots stepped as one NumPy batch."""

    def __init__(self, environment: _PointRobot, parameters: Sequence[Parameters], reward: Reward) -> None:
        self.num_lanes = len(parameters)
        self._environment, self._reward = environment, reward
        self._goals, self._winds = goals_and_winds(parameters)
        self._positions = np.zeros((self.num_lanes, 2))
        self._steps = np.zeros(self.num_lanes, dtype=np.int64)

    def reset(self, seeds: Sequence[int]) -> FloatArray:
        self._positions[:] = 0.0
        self._steps[:] = 0
        return self._positions.copy()

    def reset_lane(self, lane: int, seed: int) -> FloatArray:
        self._positions[lane] = 0.0
        self._steps[lane] = 0
        return np.zeros(2)

    def step(self, actions: FloatArray, active: BoolArray) -> LaneStep:
        moves = STEP_SIZE * np.asarray(actions, dtype=np.float64) + self._winds
        self._positions[active] += moves[active]
        self._steps += active
        distances = np.linalg.norm(self._positions - self._goals, axis=-1)
        rewards = np.where(active, self._environment.rewards(distances, self._reward), 0.0)
        truncated = active & (self._steps >= self._environment.settings.horizon)
        extras = {
            name: np.where(active, array, 0)
            for name, array in self._environment.extra_arrays(distances).items()
        }
        return LaneStep(self._positions.copy(), rewards, np.zeros_like(truncated), truncated, extras)

    def close(self) -> None:
        pass


@final
class PointRobotEnv(gymnasium.Env[FloatArray, FloatArray]):
    """One lane with Gymnasium's interface."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, lanes: PointRobotLanes) -> None:
        self._lanes = lanes

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        super().reset(seed=seed)
        return self._lanes.reset([0])[0], {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        step = self._lanes.step(np.clip(action, -1.0, 1.0)[None], np.ones(1, dtype=bool))
        return (
            step.observations[0],
            float(step.rewards[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            {name: array[0] for name, array in step.extras.items()},
        )


@final
class PointRobotCamera(FigureCamera):
    """Draws the plane of one task; `reward_radius` as of `draw_task`."""

    def __init__(
        self, parameters: Parameters, *, reward_radius: float | None, width: int, height: int
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
    axes: "Axes", parameters: Parameters, *, reward_radius: float | None, color: str = "tab:green"
) -> None:
    """Draws start, goal and wind of a task, and the half circle if the goal lies on it.

    Args:
        reward_radius: distance to the goal within which there is a reward; None if it is everywhere.
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
