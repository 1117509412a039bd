"""Ant-Dir and Ant-Goal: a four-legged robot runs in a direction, or to a goal.

Both use Gymnasium's Ant-v5 without contact forces in the observation. An action lasts 0.05 s, and the torso's
velocity over it is measured as the published code does.

Ant-Dir. The reward is v · d, the velocity along the task's direction, as in the published code of CORRO and
UNICORN. PEARL and FOCAL reward v · d - 0.5 |a|^2 - contact cost + 1, which is `reward = "full"`. An ant that
stands still then earns about 200 in every task, so that a briefly trained policy need not know its task.
Observations are positions without x and y, and velocities, 27 values.

Ant-Goal. The reward is -|p - goal|_1 - 0.1 |a|^2, where p is the position after the step, in m. PEARL and
CSRO also subtract a contact cost. In CSRO's code it is zero, because MuJoCo 2.0 with mujoco-py computes no
contact forces; here its default is zero. Observations are 29 values with x and y, as in CSRO.
"""

import math
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from tcmrl_data.envs.base import EnvironmentSettings, ObservationView, Parameters, Reward
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.envs.simulation import SimulatedEnvironment, SimulatedTask, Viewpoint, squared_norm

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACTION_DIM = 8
ALIVE_BONUS, DIRECTION_CONTROL_COST, CONTACT_COST = 1.0, 0.5, 5e-4
"""Terms of the full reward; the last is the weight of the squared contact forces, which are clipped to 1."""


class AntDirSettings(EnvironmentSettings):
    """Settings of Ant-Dir.

    Attributes:
        reward: `velocity` for v · d (published code of CORRO and UNICORN), `full` for
            v · d - 0.5 |a|^2 - contact cost + 1 (published code of PEARL, FOCAL and MACAW).
        terminate_when_unhealthy: episodes end where the torso leaves 0.2 m to 1 m (published code of PEARL
            and FOCAL: yes; of CORRO and UNICORN: no).
    """

    reward: Literal["velocity", "full"] = "velocity"
    terminate_when_unhealthy: bool = False


class AntGoalSettings(EnvironmentSettings):
    """Settings of Ant-Goal.

    Attributes:
        goal_radius: distance of the goals from the start in m (published code of CSRO: 2).
        control_cost: weight of |a|^2 (published code: 0.1).
        contact_cost: weight of the squared contact forces, clipped to 1 (published code: 5e-4, of forces that
            its simulator gives as zero).
    """

    goal_radius: float = Field(default=2.0, gt=0)
    control_cost: float = Field(default=0.1, ge=0)
    contact_cost: float = Field(default=0.0, ge=0)


@final
class AntDir(SimulatedEnvironment):
    """Directions evenly spaced on the circle; dense reward; episodes end at the horizon only."""

    name = "ant-dir"
    Settings = AntDirSettings
    observation_dim = 27
    action_dim = ACTION_DIM
    ordering_name = "direction (rad)"
    is_circular = True
    physics: ClassVar = {"observation": "qpos without x and y, qvel"}
    settings: AntDirSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        return [{"direction": angle} for angle in circle(num_tasks)]

    def ordering(self, parameters: Parameters) -> float:
        return float(parameters["direction"])

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> "AntDirTask":
        return AntDirTask(self, parameters)

    def simulator(self) -> Any:
        return _simulator(place=False, terminate=self.settings.terminate_when_unhealthy)


@final
class AntDirTask(SimulatedTask):
    """The ant with one direction, an angle in rad."""

    def __init__(self, environment: AntDir, parameters: Parameters) -> None:
        super().__init__(environment, environment.simulator())
        direction = float(parameters["direction"])
        self._direction = math.cos(direction), math.sin(direction)
        self._is_full = environment.settings.reward == "full"

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        x, y = self._direction
        along = x * float(info["x_velocity"]) + y * float(info["y_velocity"])
        if not self._is_full:
            return along
        contact = float(info["reward_contact"])  # a cost, so at most zero
        return along - DIRECTION_CONTROL_COST * squared_norm(action) + contact + ALIVE_BONUS


@final
class AntGoal(SimulatedEnvironment):
    """Goals evenly spaced on a circle around the start; dense reward; episodes end at the horizon only."""

    name = "ant-goal"
    Settings = AntGoalSettings
    observation_dim = 29
    action_dim = ACTION_DIM
    ordering_name = "goal angle (rad)"
    is_circular = True
    plane = ("x", "y")
    viewpoint: ClassVar = Viewpoint((0.0, 0.0, 0.0), distance=8.0, azimuth=90.0, elevation=-60.0)
    physics: ClassVar = {"observation": "qpos, qvel"}
    settings: AntGoalSettings

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        radius = self.settings.goal_radius
        return [{"goal": [radius * math.cos(a), radius * math.sin(a)]} for a in circle(num_tasks)]

    def ordering(self, parameters: Parameters) -> float:
        x, y = parameters["goal"]
        return math.atan2(y, x) % math.tau

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> "AntGoalTask":
        return AntGoalTask(self, parameters)

    def simulator(self) -> Any:
        return _simulator(place=True, terminate=False, contact_cost=self.settings.contact_cost)

    def draw_path(
        self, axes: "Axes", parameters: Parameters, observations: FloatArray, *, color: str
    ) -> None:
        axes.plot(0.0, 0.0, "+", color="0.3", markersize=8)
        axes.plot(*parameters["goal"], "*", color=color, markersize=11)
        axes.plot(observations[:, 0], observations[:, 1], "-", color=color, linewidth=1)
        axes.set_aspect("equal")


@final
class AntGoalTask(SimulatedTask):
    """The ant with one goal, a place (x, y) in m."""

    def __init__(self, environment: AntGoal, parameters: Parameters) -> None:
        super().__init__(environment, environment.simulator())
        x, y = parameters["goal"]
        self._goal, self._control_cost = (float(x), float(y)), environment.settings.control_cost

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        x, y = self._goal
        distance = abs(float(info["x_position"]) - x) + abs(float(info["y_position"]) - y)
        contact = float(info["reward_contact"])  # a cost, so at most zero
        return -distance - self._control_cost * squared_norm(action) + contact


def circle(number: int) -> list[float]:
    """Angles in rad, evenly spaced on the circle from 0, as in the published code of CSRO."""
    angles: list[float] = np.linspace(0.0, 2.0 * np.pi, number + 1)[:-1].tolist()
    return angles


def _simulator(*, place: bool, terminate: bool, contact_cost: float = CONTACT_COST) -> Any:
    """Gymnasium's environment; `place` keeps x and y in its observations."""
    from gymnasium.envs.mujoco.ant_v5 import AntEnv

    return AntEnv(
        contact_cost_weight=contact_cost,
        terminate_when_unhealthy=terminate,
        include_cfrc_ext_in_observation=False,
        exclude_current_positions_from_observation=not place,
    )
