"""The public module for an environment plug-in: environments, their settings, tasks, lanes and cameras.

Lanes step several episodes together. The names of controllers and trajectories are repeated here.
"""

import abc
import importlib.resources
import inspect
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from importlib.resources.abc import Traversable
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import gymnasium
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.envs.rollout import (
    BoolArray,
    Controller,
    FloatArray,
    LaneTransition,
    ObservationView,
    Trajectory,
)
from tcmrl_data.foundation.errors import RecipeError, RenderingError
from tcmrl_data.foundation.plugins import Registry, unknown_name
from tcmrl_data.foundation.records import as_model
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "DENSE_REWARDS",
    "ENVIRONMENTS",
    "BoolArray",
    "Camera",
    "Controller",
    "Environment",
    "EnvironmentLanes",
    "EnvironmentRegistry",
    "EnvironmentSettings",
    "FigureCamera",
    "FloatArray",
    "LaneStep",
    "LaneTransition",
    "Lanes",
    "ObservationView",
    "Parameters",
    "Picture",
    "Reward",
    "TaskSplit",
    "Trajectory",
    "make_environment",
]

Parameters = Mapping[str, Any]
"""JSON values that define one task."""

Reward = Literal["stored", "dense"]
"""`stored`: the reward in the dataset. `dense`: the shaped reward where the stored reward is sparse."""

DENSE_REWARDS = "dense_rewards"
"""Name of the extra array with dense (shaped) rewards, float32, in datasets with sparse rewards."""

TaskSplit = Literal["permutation", "strata", "interpolation"]
"""How test tasks are chosen; `EnvironmentSettings` explains it."""

Picture = npt.NDArray[np.uint8]
"""(height, width, 3), red, green and blue."""

FIGURE_WIDTH = 3.2
"""Width of a figure in inches; a wider picture shows the same at a higher resolution."""


class EnvironmentSettings(BaseModel):
    """The `[environment]` table of a recipe; families add their own fields.

    Attributes:
        task_seed: seed of the task parameters and of the split, by default that of the published code;
            independent of a build's `--seed`.
        horizon: steps after which an episode is truncated.
        reward_density: `sparse` if few steps have a reward (paper, Appendix F.3).
        split: how test tasks are chosen. `permutation`: drawn from all tasks. `strata`: the tasks, sorted by
            `Environment.ordering`, are divided into as many strata as there are test tasks, and one task is
            drawn from each stratum, so that test tasks cover the same range as training tasks.
            `interpolation`: the middle task of each stratum (the later one of two); nothing is drawn.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    name: str
    task_seed: int = Field(default=1337, ge=0)
    tasks: int = Field(ge=3)
    train: int = Field(ge=2)
    horizon: int = Field(ge=1)
    reward_density: Literal["dense", "sparse"] = "dense"
    split: TaskSplit = "permutation"

    @model_validator(mode="after")
    def _some_test_tasks(self) -> "EnvironmentSettings":
        if self.train >= self.tasks:
            raise ValueError(f"train ({self.train}) must be smaller than tasks ({self.tasks})")
        return self


@dataclass(frozen=True)
class LaneStep:
    """One step of all lanes; rows of inactive lanes repeat the last observation and have reward zero.

    Observations are (lanes, observation_dim) in the full view; all others are (lanes,), extra arrays by name.
    """

    observations: FloatArray
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    extras: Mapping[str, npt.NDArray[np.generic]]


class Lanes(abc.ABC):
    """Several episodes stepped together; every lane has its own task."""

    num_lanes: int

    @abc.abstractmethod
    def reset(self, seeds: Sequence[int]) -> FloatArray:
        """Starts one episode per lane; returns full observations (lanes, observation_dim)."""

    @abc.abstractmethod
    def reset_lane(self, lane: int, seed: int) -> FloatArray:
        """Starts a new episode in one lane only; returns its full observation (observation_dim,)."""

    @abc.abstractmethod
    def step(self, actions: FloatArray, active: BoolArray) -> LaneStep:
        """Steps the active lanes with actions (lanes, action_dim) in [-1, 1]."""

    @abc.abstractmethod
    def close(self) -> None:
        """Frees the simulators."""


class Camera(abc.ABC):
    """Takes pictures of one task; it changes neither the task nor its random numbers."""

    @abc.abstractmethod
    def picture(self, observations: FloatArray) -> Picture:
        """The task as it is now; observations (t + 1, observation_dim) are the episode so far, full view."""

    def close(self) -> None:
        """Frees the camera's resources; does nothing by default."""


class FigureCamera(Camera):
    """Base class of cameras that draw observations with matplotlib; width and height are in pixels."""

    def __init__(self, width: int, height: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        dpi = width / FIGURE_WIDTH
        self._canvas = FigureCanvasAgg(Figure(figsize=(FIGURE_WIDTH, height / dpi), dpi=dpi))
        self._axes = self._canvas.figure.add_axes((0.0, 0.0, 1.0, 1.0))

    @abc.abstractmethod
    def draw(self, axes: "Axes", observations: FloatArray) -> None:
        """Draws the task on empty axes without a frame, and sets their limits; arguments as for `picture`."""

    def picture(self, observations: FloatArray) -> Picture:
        self._axes.clear()
        self._axes.set_axis_off()
        self.draw(self._axes, observations)
        canvas: Any = self._canvas  # matplotlib's types leave these methods out
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@final
class RenderedCamera(Camera):
    """Gymnasium's own pictures of a task whose render mode is `rgb_array`, in the simulator's size."""

    def __init__(self, task: gymnasium.Env[Any, Any]) -> None:
        self._task = task

    def picture(self, observations: FloatArray) -> Picture:
        return np.asarray(self._task.render(), dtype=np.uint8)


class Environment(abc.ABC):
    """A family of tasks with the same state and action space.

    A subclass is final, sets the class attributes and is a plug-in of the entry point group
    `tcmrl.environments`. Its module does not import a simulator (mujoco, metaworld) at the top; `make` does.
    """

    name: str
    """The plug-in's name on the class; the environment's name, such as `ml1/reach`, on an instance."""
    Settings: ClassVar[type[EnvironmentSettings]] = EnvironmentSettings
    observation_dim: int
    action_dim: int
    extras: ClassVar[Mapping[str, type[np.generic]]] = {}
    """Dtypes of further per-step arrays, by name."""
    ordering_name: ClassVar[str | None] = None
    """What `ordering` measures, with its unit; None if tasks have no order."""
    is_circular: ClassVar[bool] = False
    """Whether `ordering` is a position on a circle, so that the last task is next to the first."""
    plane: ClassVar[tuple[str, str] | None] = None
    """Labels of the first two observation columns if they are a position in the plane, else None."""
    simulator_bytes: ClassVar[int] = 0
    """Measured memory of one task's simulator in bytes; 0 without a simulator."""

    def __init__(self, settings: EnvironmentSettings) -> None:
        if settings.split != "permutation" and self.ordering_name is None:
            raise RecipeError(
                f"environment.split is '{settings.split}', but the tasks of {settings.name} have no order; "
                "set it to 'permutation'"
            )
        self.settings = settings
        self.name = settings.name

    @classmethod
    def members(cls) -> list[str]:
        """Names of the class's environments: the plug-in's name, or several names `<plug-in>/<member>`."""
        return [cls.name]

    @classmethod
    def provides(cls, name: str) -> bool:
        """Whether datasets of the environment `name` belong to this class."""
        return name in cls.members()

    @classmethod
    def recipe_file(cls, name: str) -> Traversable:
        """The TOML recipe of the environment `name`: `<name>.toml` beside the class's module."""
        file = f"{name.partition('/')[0]}.toml"
        if cls.__module__.partition(".")[0] == "tcmrl_data":
            return importlib.resources.files("tcmrl_manifests") / file
        return Path(inspect.getfile(cls)).with_name(file)

    @abc.abstractmethod
    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        """Draws the parameters of all tasks as the published code does; JSON values.

        `draw_tasks` rounds floats to ten significant digits. Prefer Python's `math` to NumPy's array
        functions, whose last digits depend on the processor's instruction set.
        """

    def ordering(self, parameters: Parameters) -> float | None:
        """The number by which tasks are sorted, such as a goal's angle or a velocity; None if there is none.

        A class that overrides this method also sets `ordering_name`.
        """
        return None

    @abc.abstractmethod
    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> gymnasium.Env[Any, Any]:
        """Makes one task as a Gymnasium environment with actions in [-1, 1], truncated at the horizon.

        `view` chooses the observations. Both values of `reward` are the same if the stored reward is dense.
        """

    def lanes(self, parameters: Sequence[Parameters], *, reward: Reward = "stored") -> Lanes:
        """Lanes with the full view, one per entry of `parameters`; `reward` as for `make`."""
        return EnvironmentLanes(self, [self.make(task, view="full", reward=reward) for task in parameters])

    def stored_view(self, observations: FloatArray) -> FloatArray:
        """The stored view of full observations (..., observation_dim)."""
        return observations

    def oracle(self, parameters: Sequence[Parameters]) -> Controller | None:
        """A (nearly) optimal controller that knows the lanes' tasks; None if there is none."""
        return None

    def scripted(self, parameters: Sequence[Parameters], noise: float) -> Controller | None:
        """The environment's expert per lane, with N(0, noise) added to actions; None if there is none."""
        return None

    def camera(
        self, task: gymnasium.Env[Any, Any], parameters: Parameters, *, width: int, height: int
    ) -> Camera | None:
        """A camera for a task, by default what its `render` returns if it was made with `rgb_array`.

        None if the environment cannot be drawn.

        Args:
            task: made by `make` with the full view; it plays an episode while pictures are taken.
            width: width of a picture in pixels.
            height: height of a picture in pixels.

        Raises:
            RenderingError: this machine cannot draw the task.
        """
        return RenderedCamera(task) if task.render_mode == "rgb_array" else None

    def draw_path(
        self, axes: "Axes", parameters: Parameters, observations: FloatArray, *, color: str
    ) -> None:
        """Draws a task and the path of one of its episodes, if observations are positions in a plane.

        Args:
            axes: matplotlib's axes, which may show other tasks too.
            observations: (T + 1, observation_dim), stored view.
            color: the task's color for matplotlib.

        Raises:
            RenderingError: observations are not positions in a plane (the default).
        """
        raise RenderingError(
            f"paths of {self.name} cannot be drawn, because its observations are not positions in a plane"
        )

    def fingerprint(self) -> dict[str, Any]:
        """JSON values of everything that the dynamics depend on: library versions, time step, model hash."""
        return {}


@final
class EnvironmentLanes(Lanes):
    """Lanes that step Gymnasium environments, made with the full view, one after another."""

    def __init__(self, environment: Environment, tasks: Sequence[gymnasium.Env[Any, Any]]) -> None:
        self.num_lanes = len(tasks)
        self._extras = environment.extras
        self._environments = list(tasks)
        self._observations = np.zeros((self.num_lanes, environment.observation_dim))

    def reset(self, seeds: Sequence[int]) -> FloatArray:
        for lane, seed in zip(range(self.num_lanes), seeds, strict=True):
            self.reset_lane(lane, seed)
        return self._observations.copy()

    def reset_lane(self, lane: int, seed: int) -> FloatArray:
        self._observations[lane] = self._environments[lane].reset(seed=seed)[0]
        observation: FloatArray = self._observations[lane].copy()
        return observation

    def step(self, actions: FloatArray, active: BoolArray) -> LaneStep:
        rewards = np.zeros(self.num_lanes)
        terminated, truncated = np.zeros((2, self.num_lanes), dtype=bool)
        extras = {name: np.zeros(self.num_lanes, dtype) for name, dtype in self._extras.items()}
        for lane in np.flatnonzero(active):
            step = self._environments[lane].step(actions[lane])
            self._observations[lane], rewards[lane], terminated[lane], truncated[lane], info = step
            for name in extras:
                extras[name][lane] = info[name]
        return LaneStep(self._observations.copy(), rewards, terminated, truncated, extras)

    def close(self) -> None:
        for environment in self._environments:
            environment.close()


def _own_entries() -> Sequence[EntryPoint]:
    """The environments that `TCMRL_ENVIRONMENTS` names, of files that no package declares."""
    if not os.environ.get("TCMRL_ENVIRONMENTS"):
        return []
    from tcmrl_data.envs.own import own_entries

    return own_entries()


@final
class EnvironmentRegistry(Registry[Environment]):
    """Environments by name; one plug-in may provide several environments."""

    def names(self) -> list[str]:
        return sorted({*super().names(), *(entry.name for entry in _own_entries())})

    def _entries(self) -> dict[str, list[EntryPoint]]:
        found = super()._entries()
        for entry in _own_entries():
            found.setdefault(entry.name, []).append(entry)
        return found

    def get(self, name: str) -> type[Environment]:
        family = super().get(name.partition("/")[0])
        if not family.provides(name):
            raise unknown_name(self.noun, name, family.members())
        return family

    def defect(self, found: Any, name: str) -> str | None:
        defect = super().defect(found, name)
        foreign = [] if defect else [item for item in found.members() if item.partition("/")[0] != name]
        return f"has the member {foreign[0]!r} outside {name!r}" if foreign else defect

    def members(self) -> list[str]:
        """The environments of all working plug-ins, sorted; imports the plug-ins."""
        return sorted(name for family in self.working().values() for name in family.members())


ENVIRONMENTS = EnvironmentRegistry("tcmrl.environments", "environment", Environment)


def make_environment(settings: Mapping[str, Any]) -> Environment:
    """The environment of an `[environment]` table.

    Raises:
        UnknownNameError: there is no such environment.
        RecipeError: the split needs an order, and the tasks have none.
        ValidationError: pydantic's; the table is not valid.
    """
    kind = ENVIRONMENTS.get(settings["name"])
    return kind(as_model(kind.Settings, settings))


Split = Literal["train", "test"]

PARAMETER_DIGITS = 10
"""Significant decimal digits of a task parameter.

Vectorized functions (`exp`, `pow`, `sin`) and fused multiply-adds differ between instruction sets in the last
of a double's 16 to 17 digits. Ten digits are the same on all of them, and more than a dataset's float32 has.
"""


@dataclass(frozen=True)
class Task:
    """One task of an environment.

    Attributes:
        index: position in the full task set; the same in every profile and selection.
        parameters: JSON values that define the task.
    """

    index: int
    split: Split
    parameters: Mapping[str, Any]


def draw_tasks(environment: Environment) -> tuple[Task, ...]:
    """Draws all tasks of an environment; depends on its settings only (`task_seed`, not `--seed`).

    Floating-point parameters are rounded to PARAMETER_DIGITS significant digits, so that they are the same
    bits on every processor.
    """
    settings = environment.settings
    drawn = environment.draw_parameters(settings.tasks, settings.task_seed)
    tasks = [Task(index, "train", _rounded(parameters)) for index, parameters in enumerate(drawn)]
    generator = keyed_generator(settings.task_seed, environment.name, NO_TASK, Purpose.SPLIT)
    order = [task.index for task in in_order(environment, tasks)]
    match settings.split:
        case "strata":
            test = draw_from_strata(order, settings.tasks - settings.train, generator)
        case "interpolation":
            test = middles_of_strata(order, settings.tasks - settings.train)
        case "permutation":
            test = set(generator.permutation(settings.tasks)[settings.train :].tolist())
    return tuple(replace(task, split="test") if task.index in test else task for task in tasks)


def in_order(environment: Environment, tasks: Iterable[Task]) -> list[Task]:
    """The tasks sorted by the environment's ordering, or by index if it has none."""
    return sorted(tasks, key=lambda task: (place_in_order(environment, task) or 0.0, task.index))


def place_in_order(environment: Environment, task: Task) -> float | None:
    """The value of the environment's ordering for a task; None if there is none.

    Tasks of imported data may have no parameters, or other ones than the environment draws.
    """
    try:
        return environment.ordering(task.parameters)
    except (LookupError, TypeError, ValueError, OverflowError):
        return None


def draw_from_strata(order: Sequence[int], number: int, generator: np.random.Generator) -> set[int]:
    """Draws one item from each of `number` consecutive strata, whose sizes differ by at most one."""
    return {order[int(generator.integers(start, stop))] for start, stop in _strata(len(order), number)}


def middles_of_strata(order: Sequence[int], number: int) -> set[int]:
    """The middle item of each stratum of `draw_from_strata`."""
    return {order[(start + stop) // 2] for start, stop in _strata(len(order), number)}


def _strata(size: int, number: int) -> Iterator[tuple[int, int]]:
    """Start and stop position of each of `number` strata."""
    return pairwise(stratum * size // number for stratum in range(number + 1))


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{PARAMETER_DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(member) for key, member in value.items()}
    return [_rounded(member) for member in value] if isinstance(value, list | tuple) else value
