"""What an environment is: settings, task parameters, a Gymnasium environment, and lanes stepped together."""

import abc
import importlib.resources
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from typing import Any, ClassVar, Literal, final

import gymnasium
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.envs.controller import Controller, View
from tcmrl_data.envs.trajectory import BoolArray, FloatArray
from tcmrl_data.foundation.plugins import Registry, unknown_name

Parameters = Mapping[str, Any]
"""JSON values that define one task."""

Reward = Literal["stored", "dense"]
"""`stored`: what the dataset holds. `dense`: shaped, where the stored reward is sparse."""


class EnvironmentSettings(BaseModel):
    """The `[environment]` table of a recipe; families add their own fields.

    Attributes:
        name: the environment's name.
        task_seed: seeds task parameters and split; independent of a build's `--seed`.
        tasks: size of the full task set.
        train: how many of them are training tasks.
        horizon: steps after which an episode is truncated.
        reward_density: `sparse` where few steps carry reward (paper, Appendix F.3).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    name: str
    task_seed: int = Field(ge=0)
    tasks: int = Field(ge=3)
    train: int = Field(ge=2)
    horizon: int = Field(ge=1)
    reward_density: Literal["dense", "sparse"] = "dense"

    @model_validator(mode="after")
    def _some_test_tasks(self) -> "EnvironmentSettings":
        if self.train >= self.tasks:
            raise ValueError(f"train ({self.train}) must be smaller than tasks ({self.tasks})")
        return self


@dataclass(frozen=True)
class LaneStep:
    """One step of all lanes; rows of inactive lanes repeat the last observation with zero reward.

    Attributes:
        observations: (lanes, observation_dim), full view.
        rewards: (lanes,).
        terminated: (lanes,) bool.
        truncated: (lanes,) bool.
        extras: per-lane values of the environment's extra arrays, each (lanes,).
    """

    observations: FloatArray
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    extras: Mapping[str, npt.NDArray[np.generic]]


class Lanes(abc.ABC):
    """Episodes stepped together, each lane with its own task."""

    num_lanes: int

    @abc.abstractmethod
    def reset(self, seeds: Sequence[int]) -> FloatArray:
        """Starts one episode per lane; full observations (lanes, observation_dim)."""

    @abc.abstractmethod
    def reset_lane(self, lane: int, seed: int) -> FloatArray:
        """Starts a new episode in one lane, the others go on; its full observation (observation_dim,)."""

    @abc.abstractmethod
    def step(self, actions: FloatArray, active: BoolArray) -> LaneStep:
        """Steps the active lanes with actions (lanes, action_dim) in [-1, 1]."""

    @abc.abstractmethod
    def close(self) -> None:
        """Frees what the lanes hold."""


class Environment(abc.ABC):
    """A family of tasks with one state and action space.

    Subclasses set the class attributes and are final; nothing heavy (mujoco, metaworld) is imported
    before a task is made. They are plug-ins of the entry point group `tcmrl.environments`.
    """

    name: str
    """On the class, the plug-in's name; on an instance, the environment's, such as `ml1/reach`."""
    Settings: ClassVar[type[EnvironmentSettings]] = EnvironmentSettings
    observation_dim: int
    action_dim: int
    extras: ClassVar[Mapping[str, type[np.generic]]] = {}
    """Per-step arrays beside the standard ones, name to dtype."""
    simulator_bytes: ClassVar[int] = 0
    """Memory of one simulated task, as measured; 0 where a task is a handful of numbers."""

    def __init__(self, settings: EnvironmentSettings) -> None:
        self.settings = settings
        self.name = settings.name

    @classmethod
    def members(cls) -> list[str]:
        """Names of the environments of this class: one, or `<plug-in>/<member>` for a family of several."""
        return [cls.name]

    @classmethod
    def recipe_file(cls, name: str) -> Traversable:
        """The recipe, a TOML file, of the environment `name`; a package of its own brings its own file."""
        return importlib.resources.files("tcmrl_manifests") / f"{name.partition('/')[0]}.toml"

    @abc.abstractmethod
    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        """Parameters of all tasks, drawn once as the field's code draws them; JSON values."""

    @abc.abstractmethod
    def make(
        self, parameters: Parameters, *, view: View = "stored", reward: Reward = "stored"
    ) -> gymnasium.Env[Any, Any]:
        """One task as a Gymnasium environment: actions in [-1, 1], truncated at the horizon.

        Args:
            parameters: the task.
            view: observations to show.
            reward: `dense` for the shaped reward of an environment whose stored reward is sparse;
                the same as `stored` elsewhere.
        """

    def lanes(self, parameters: Sequence[Parameters], *, reward: Reward = "stored") -> Lanes:
        """One lane per entry: full view, `reward` as for `make`."""
        return EnvironmentLanes(self, parameters, reward)

    def stored_view(self, observations: FloatArray) -> FloatArray:
        """Hides what the task hides from full observations (..., observation_dim)."""
        return observations

    def oracle(self, parameters: Sequence[Parameters]) -> Controller | None:
        """A controller that knows each lane's task, where one can be computed."""
        return None

    def scripted(self, parameters: Sequence[Parameters], noise: float) -> Controller | None:
        """The environment's expert for each lane plus N(0, noise) per action, where one exists."""
        return None

    def fingerprint(self) -> dict[str, Any]:
        """What the dynamics depend on beside the parameters: library versions, dt, model hash; JSON."""
        return {}


@final
class EnvironmentLanes(Lanes):
    """Lanes over single Gymnasium environments, stepped one after another."""

    def __init__(self, environment: Environment, parameters: Sequence[Parameters], reward: Reward) -> None:
        self.num_lanes = len(parameters)
        self._extras = environment.extras
        self._environments = [environment.make(each, view="full", reward=reward) for each in parameters]
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


@final
class EnvironmentRegistry(Registry[Environment]):
    """Environments by name; a plug-in may be a family of several."""

    def get(self, name: str) -> type[Environment]:
        family = super().get(name.partition("/")[0])
        if name not in family.members():
            raise unknown_name(self.noun, name, family.members())
        return family

    def defect(self, found: Any, name: str) -> str | None:
        defect = super().defect(found, name)
        strangers = [] if defect else [each for each in found.members() if each.partition("/")[0] != name]
        return f"has the member {strangers[0]!r} outside {name!r}" if strangers else defect

    def members(self) -> list[str]:
        """The environments of all plug-ins that are not broken, sorted; imports the plug-ins."""
        return sorted(name for family in self.working().values() for name in family.members())


ENVIRONMENTS = EnvironmentRegistry("tcmrl.environments", "environment", Environment)


def make_environment(settings: Mapping[str, Any]) -> Environment:
    """The environment of a validated `[environment]` table (raises pydantic's error for a bad one)."""
    kind = ENVIRONMENTS.get(settings["name"])
    return kind(kind.Settings.model_validate_json(json.dumps(settings)))
