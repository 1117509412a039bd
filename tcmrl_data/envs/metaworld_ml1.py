"""Meta-World ML1: manipulation task sets with hidden goals and object positions.

`ml1/<task-set>` is Meta-World's `<task-set>-v3` (the paper's names end in -v2). A task is one of the fifty
`ML1(<task-set>-v3, seed=task_seed).train_tasks`, defined by its random vector. The last three of the 39
observation values are the goal: the view `full` contains it, the view `stored` contains zeros instead.
Reward and dynamics do not depend on the view.
"""

import functools
import pickle
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar, final

import numpy as np
from pydantic import Field

from tcmrl_data.envs.base import Controller, EnvironmentSettings, ObservationView, Parameters, Reward
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.envs.simulation import SimulatedEnvironment, SimulatedTask, Viewpoint
from tcmrl_data.foundation.errors import TaskError

GOAL = slice(-3, None)
TASKS_PER_SET = 50
TASK_SETS = (
    "assembly", "basketball", "bin-picking", "box-close", "button-press", "button-press-topdown",
    "button-press-topdown-wall", "button-press-wall", "coffee-button", "coffee-pull", "coffee-push",
    "dial-turn", "disassemble", "door-close", "door-lock", "door-open", "door-unlock", "drawer-close",
    "drawer-open", "faucet-close", "faucet-open", "hammer", "hand-insert", "handle-press",
    "handle-press-side", "handle-pull", "handle-pull-side", "lever-pull", "peg-insert-side",
    "peg-unplug-side", "pick-out-of-hole", "pick-place", "pick-place-wall", "plate-slide",
    "plate-slide-back", "plate-slide-back-side", "plate-slide-side", "push", "push-back", "push-wall",
    "reach", "reach-wall", "shelf-place", "soccer", "stick-pull", "stick-push", "sweep", "sweep-into",
    "window-close", "window-open",
)  # fmt: skip
"""The names of the task sets; a literal, so that listing environments does not import Meta-World."""


class MetaWorldML1Settings(EnvironmentSettings):
    """Settings of ML1.

    Attributes:
        tasks: number of tasks, at most the 50 training tasks that ML1 draws.
    """

    tasks: int = Field(ge=3, le=TASKS_PER_SET)


@final
class MetaWorldML1(SimulatedEnvironment):
    """One ML1 task set; episodes end only at the horizon; `success` is Meta-World's value per step."""

    name = "ml1"
    Settings = MetaWorldML1Settings
    observation_dim = 39
    action_dim = 4
    plane = ("hand, x in m", "hand, y in m")
    simulator_bytes = 24 * 2**20
    packages = ("metaworld",)
    # in front of the table; Meta-World's own cameras stand upside down
    viewpoint: ClassVar = Viewpoint((0.0, 0.68, 0.14), distance=1.35, azimuth=225.0, elevation=-25.0)
    extras: ClassVar = {"success": np.bool_}

    def __init__(self, settings: EnvironmentSettings) -> None:
        super().__init__(settings)
        self._env_name = f"{self.name.removeprefix('ml1/')}-v3"

    @classmethod
    def members(cls) -> list[str]:
        return [f"{cls.name}/{task_set}" for task_set in TASK_SETS]

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        vectors = _random_vectors(self._env_name, task_seed)[:num_tasks]
        return [
            {"env_name": self._env_name, "rand_vec": list(vector), "partially_observable": True}
            for vector in vectors
        ]

    def make(
        self, parameters: Parameters, *, view: ObservationView = "stored", reward: Reward = "stored"
    ) -> "MetaWorldML1Task":
        if parameters["env_name"] != self._env_name:
            raise TaskError(
                f"{self.name}: a task of {parameters['env_name']!r} does not belong to this environment"
            )
        return MetaWorldML1Task(self, parameters, view=view)

    def stored_view(self, observations: FloatArray) -> FloatArray:
        hidden = observations.copy()
        hidden[..., GOAL] = 0.0
        return hidden

    def scripted(self, parameters: Sequence[Parameters], noise: float) -> "ExpertController":
        return ExpertController([task["env_name"] for task in parameters], noise)

    def simulator(self) -> Any:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS

        return ALL_V3_ENVIRONMENTS[self._env_name]()


@functools.cache
def _random_vectors(env_name: str, task_seed: int) -> tuple[tuple[float, ...], ...]:
    """The random vectors of ML1's training tasks; cached, because making ML1 resets a simulator 100 times."""
    import metaworld

    benchmark: Any = metaworld.ML1
    # these pickles are safe: Meta-World makes them in this process
    drawn = [pickle.loads(task.data) for task in benchmark(env_name, seed=task_seed).train_tasks]
    return tuple(tuple(float(value) for value in task["rand_vec"]) for task in drawn)


@final
class MetaWorldML1Task(SimulatedTask):
    """One goal of a task set."""

    def __init__(self, environment: MetaWorldML1, parameters: Parameters, *, view: ObservationView) -> None:
        from metaworld.types import Task

        # made without Meta-World's benchmark object, which is slow; the goal is hidden in `observe`
        simulator, vector = environment.simulator(), np.array(parameters["rand_vec"])
        task = {"env_cls": type(simulator), "rand_vec": vector, "partially_observable": False}
        # a step beyond it raises an error
        simulator.max_path_length = max(simulator.max_path_length, environment.settings.horizon)
        simulator.set_task(Task(parameters["env_name"], pickle.dumps(task)))
        super().__init__(environment, simulator)
        self._hides_goal = view == "stored"

    def observe(self, observation: FloatArray) -> FloatArray:
        shown = observation.copy()
        if self._hides_goal:
            shown[GOAL] = 0.0
        return shown

    def reward(self, action: FloatArray, simulator_reward: float, info: dict[str, Any]) -> float:
        return simulator_reward

    def extras(self, info: dict[str, Any]) -> dict[str, Any]:
        return {"success": bool(info["success"])}


@final
class ExpertController(Controller):
    """Meta-World's scripted experts, one per lane; adds N(0, noise) to actions and clips them to [-1, 1].

    Args:
        noise: standard deviation of the noise (published data: 0.1).
    """

    view: ObservationView = "full"

    def __init__(self, env_names: Sequence[str], noise: float) -> None:
        from metaworld.policies import ENV_POLICY_MAP

        experts: dict[str, Any] = ENV_POLICY_MAP
        self._experts = [experts[name]() for name in env_names]
        self._noise = noise

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        with warnings.catch_warnings():
            # experts exceed the action limits on purpose, and Meta-World warns at every step
            warnings.filterwarnings("ignore", message="Constant")
            actions = np.stack(
                [
                    expert.get_action(np.asarray(row, dtype=np.float64))
                    for expert, row in zip(self._experts, observations, strict=True)
                ]
            )
        clipped: FloatArray = np.clip(actions + self._noise * noise, -1.0, 1.0)
        return clipped
