"""Episodes of a policy in its task: the rollouts of a build, and further ones of stored policies."""

from collections.abc import Mapping
from typing import Any, ClassVar, final

import numpy as np
from pydantic import Field

from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.controller import Controller, NoisyController, Trajectory, UniformController
from tcmrl_data.envs.rollout import roll_out
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed
from tcmrl_data.parts.operation import Operation, Simulator, Sources, WantedPart, check_finite
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import PartRecord, References
from tcmrl_data.store.tables import MAX_INDEX

EXTEND = "extend"
MAX_NOISE = 10.0

StreamKey = tuple[int, str, int, Purpose, *tuple[int, ...]]
"""Arguments of `keyed_sequence` but for the episode."""


@final
class Rollout(Operation[Record]):
    """The recipe's episodes of a policy in the task that it was made for; its parts have no `derived`."""

    name = "rollout"
    kinds = ("built",)
    Settings = Record
    simulates = True
    own_seeds = True

    def __init__(self, settings: Record | None = None) -> None:
        super().__init__(settings or Record())

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The episodes 0, 1, … of the policy's keyed seeds."""
        return act(_policy_of(wanted), sources.running, parameters=wanted.task.parameters)

    def derived(self, source: PartRecord) -> None:
        """None: it is made from no other part."""

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """The task and the position."""
        return task, number


class ExtendSettings(Record):
    """Settings of an extended part.

    Attributes:
        task: the task that the policy was made for.
        parameters: of that task; scripted policies act by them.
        first_episode: number of the part's first episode among those of its keyed seeds.
        noise: standard deviation of normal noise that was added to actions.
    """

    task: int = Field(ge=0, lt=MAX_INDEX)
    parameters: dict[str, Any]
    first_episode: int = Field(ge=0, lt=MAX_INDEX)
    noise: float = Field(ge=0, le=MAX_NOISE)


@final
class Extend(Operation[ExtendSettings]):
    """Further episodes of a stored policy, in its own task or in another."""

    name = EXTEND
    kinds = ("extended",)
    Settings = ExtendSettings
    simulates = True
    own_seeds = True
    example: ClassVar[Mapping[str, Any]] = {"first_episode": 4, "noise": 0.1}

    @classmethod
    def settings_for(cls, settings: Mapping[str, Any], source: Task) -> Mapping[str, Any]:
        """The settings with the policy's task."""
        return {"task": source.index, "parameters": dict(source.parameters), **settings}

    @classmethod
    def settings_of(cls, run: Run, source: Run) -> Mapping[str, Any]:
        """First episode and noise, as the run's origin says."""
        return {name: (run.origin or {}).get(name) for name in ("first_episode", "noise")}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """As many episodes as the recipe says, from `first_episode` on."""
        settings = self.settings
        return act(
            _policy_of(wanted),
            sources.running,
            parameters=settings.parameters,
            first_episode=settings.first_episode,
            noise=settings.noise,
        )

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """Episodes are counted from `first_episode`."""
        return task, self.settings.first_episode + number


def _policy_of(wanted: WantedPart) -> Snapshot:
    if wanted.snapshot is None:
        raise BuildError("its policy is not known")
    return wanted.snapshot


def act(
    snapshot: Snapshot,
    simulator: Simulator,
    *,
    parameters: Mapping[str, Any],
    first_episode: int = 0,
    noise: float = 0.0,
) -> list[Trajectory]:
    """The recipe's episodes of one policy, in lane batches; every episode has its own keyed seeds.

    Args:
        snapshot: the policy.
        simulator: of the task in which it acts.
        parameters: of the task that the policy was made for.
        first_episode: number of the first episode; a multiple of the lanes, so that batches are the same.
        noise: standard deviation of normal noise that is added to actions.
    """
    environment, step = simulator.environment, snapshot.step
    key = (simulator.seed, environment.name, simulator.task.index)
    return _batches(
        simulator,
        snapshot.controller(environment, [parameters] * simulator.lanes.num_lanes),
        episodes=range(first_episode, first_episode + simulator.recipe.rollouts.episodes),
        reset_key=(*key, Purpose.ROLLOUT_RESET, step),
        noise_key=(*key, Purpose.ROLLOUT_NOISE, step),
        added_noise=(noise, (*key, Purpose.EXTENSION_NOISE, step)) if noise else None,
    )


def measure_references(simulator: Simulator) -> References:
    """Uniform, oracle and noise-free scripted returns of the task, over as many episodes as a part has."""
    environment, parameters = simulator.environment, [simulator.task.parameters] * simulator.num_lanes
    key = (simulator.seed, environment.name, simulator.task.index)

    def mean_return(controller: Controller | None) -> float | None:
        if controller is None:
            return None
        trajectories = _batches(
            simulator,
            controller,
            episodes=range(simulator.recipe.rollouts.episodes),
            reset_key=(*key, Purpose.REFERENCE_RESET),
            noise_key=(*key, Purpose.REFERENCE_NOISE),
        )
        check_finite(trajectories, f"{environment.name}, task {simulator.task.index}, reference rollouts")
        return float(np.mean([trajectory.undiscounted_return for trajectory in trajectories]))

    return References(
        uniform=mean_return(UniformController()),
        oracle=mean_return(environment.oracle(parameters)),
        scripted=mean_return(environment.scripted(parameters, 0.0)),
    )


def _batches(
    simulator: Simulator,
    controller: Controller,
    *,
    episodes: range,
    reset_key: StreamKey,
    noise_key: StreamKey,
    added_noise: tuple[float, StreamKey] | None = None,
) -> list[Trajectory]:
    lanes, trajectories = simulator.lanes, list[Trajectory]()
    for first in range(episodes.start, episodes.stop, lanes.num_lanes):
        batch = range(first, first + lanes.num_lanes)
        acting = controller
        if added_noise is not None:
            sigma, key = added_noise
            acting = NoisyController(controller, sigma, [keyed_generator(*key, episode) for episode in batch])
        trajectories += roll_out(
            simulator.environment,
            lanes,
            acting,
            reset_seeds=[keyed_seed(*reset_key, episode) for episode in batch],
            noise=[keyed_generator(*noise_key, episode) for episode in batch],
        )
    return trajectories
