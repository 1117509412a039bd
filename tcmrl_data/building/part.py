"""The making of a part: a snapshot's rollouts, their record, and their publication."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np

from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.building.published import Published, read_published
from tcmrl_data.envs.base import Environment, Lanes, Parameters
from tcmrl_data.envs.controller import Controller, NoisyController, UniformController
from tcmrl_data.envs.rollout import roll_out
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.errors import BuildError, NondeterminismError
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed
from tcmrl_data.store.keys import MAIN_RUN, PartKey, part_file
from tcmrl_data.store.part_making import make_part
from tcmrl_data.store.part_record import PartRecord, References


@final
class PartMaker:
    """Rolls out and publishes the snapshots of one task, with one set of lanes.

    Args:
        dataset: its folder.
        plan: of the build.
        task: whose snapshots these are.
        behavior: what the behavior source has recorded with its parts.
    """

    def __init__(
        self,
        dataset: Path,
        plan: BuildPlan,
        *,
        task: Task,
        behavior: Mapping[str, Any],
    ) -> None:
        self.task = task
        self._dataset, self._plan, self._behavior = dataset, plan, behavior
        self._parameters = [task.parameters] * plan.recipe.rollouts.lanes
        self._lanes: Lanes | None = None
        self._references: References | None = None

    def close(self) -> None:
        """Frees the lanes; closing twice does no harm."""
        if self._lanes is not None:
            self._lanes.close()
            self._lanes = None

    def publish(self, snapshot: Snapshot) -> Published | None:
        """Publishes the part of a snapshot; one that is there already is left alone, and None is returned.

        Raises:
            NondeterminismError: the part that is there was made on an equal platform from another policy.
        """
        file = self._dataset / part_file(PartKey(self.task.index, snapshot.step))
        if not file.exists():
            record, data = self._make(snapshot)
            replace_file(file, data, staging=self._dataset / STAGING)
            return Published.of_record(record, run=MAIN_RUN, archive=data)
        _, record = read_published(file, MAIN_RUN)
        same_platform = record.platform.digest() == self._plan.platform.digest()
        if same_platform and record.identity.policy != snapshot.digest():
            raise NondeterminismError(
                f"{file}: its policy differs from the one trained now with the same seed"
            )
        return None

    def _make(self, snapshot: Snapshot) -> tuple[PartRecord, bytes]:
        """The record and the archive of the snapshot's part."""
        plan, task = self._plan, self.task
        if self._lanes is None:
            self._lanes = plan.environment.lanes(self._parameters)
        trajectories = roll_out_part(plan, task=task, snapshot=snapshot, lanes=self._lanes)
        place = f"{plan.environment.name}, task {task.index}, snapshot step {snapshot.step}"
        check_finite(trajectories, place)
        if self._references is None:
            self._references = self._measure_references()
        return seal_part(
            plan,
            task=task,
            snapshot=snapshot,
            trajectories=trajectories,
            references=self._references,
            behavior=self._behavior,
        )

    def _measure_references(self) -> References:
        """Uniform, oracle and noise-free scripted returns of the task, over as many episodes as in a part."""
        environment, lanes = self._plan.environment, self._lanes
        assert lanes is not None
        key = (self._plan.seed, environment.name, self.task.index)

        def mean_return(controller: Controller | None) -> float | None:
            if controller is None:
                return None
            trajectories = _roll_out_batches(
                environment,
                lanes,
                controller,
                episodes=range(self._plan.recipe.rollouts.episodes),
                reset_key=(*key, Purpose.REFERENCE_RESET),
                noise_key=(*key, Purpose.REFERENCE_NOISE),
            )
            check_finite(trajectories, f"{environment.name}, task {self.task.index}, reference rollouts")
            return float(np.mean([trajectory.undiscounted_return for trajectory in trajectories]))

        uniform = mean_return(UniformController())
        assert uniform is not None
        return References(
            uniform=uniform,
            oracle=mean_return(environment.oracle(self._parameters)),
            scripted=mean_return(environment.scripted(self._parameters, 0.0)),
        )


def seal_part(
    plan: BuildPlan,
    *,
    task: Task,
    snapshot: Snapshot,
    trajectories: Sequence[Trajectory],
    references: References,
    behavior: Mapping[str, Any],
) -> tuple[PartRecord, bytes]:
    """The record and the archive of a part.

    Args:
        plan: of the build.
        task: the part's.
        snapshot: the policy.
        trajectories: its rollouts.
        references: of the task.
        behavior: what the behavior source records with its parts.
    """
    return make_part(
        settings=plan.recipe.unit_settings(),
        task=task,
        step=snapshot.step,
        seed=plan.seed,
        snapshot=snapshot,
        trajectories=trajectories,
        references=references,
        behavior=behavior,
        platform=plan.platform,
    )


def roll_out_part(
    plan: BuildPlan,
    *,
    task: Task,
    snapshot: Snapshot,
    lanes: Lanes,
    policy_parameters: Parameters | None = None,
    first_episode: int = 0,
    noise: float = 0.0,
) -> list[Trajectory]:
    """The recipe's episodes of one snapshot, in lane batches; every episode has its own keyed seeds.

    Args:
        plan: of the build.
        task: in which the policy acts.
        snapshot: the policy.
        lanes: of the task.
        policy_parameters: of the task that the policy was made for; None for `task`.
        first_episode: number of the first episode; a multiple of the lanes, so that batches are the same.
        noise: standard deviation of normal noise that is added to actions.
    """
    environment = plan.environment
    parameters = task.parameters if policy_parameters is None else policy_parameters
    controller = snapshot.controller(environment, [parameters] * lanes.num_lanes)
    key = (plan.seed, environment.name, task.index)
    return _roll_out_batches(
        environment,
        lanes,
        controller,
        episodes=range(first_episode, first_episode + plan.recipe.rollouts.episodes),
        reset_key=(*key, Purpose.ROLLOUT_RESET, snapshot.step),
        noise_key=(*key, Purpose.ROLLOUT_NOISE, snapshot.step),
        added_noise=(noise, (*key, Purpose.EXTENSION_NOISE, snapshot.step)) if noise else None,
    )


StreamKey = tuple[int, str, int, Purpose, *tuple[int, ...]]
"""Arguments of `keyed_sequence` but for the episode."""


def _roll_out_batches(
    environment: Environment,
    lanes: Lanes,
    controller: Controller,
    *,
    episodes: range,
    reset_key: StreamKey,
    noise_key: StreamKey,
    added_noise: tuple[float, StreamKey] | None = None,
) -> list[Trajectory]:
    trajectories: list[Trajectory] = []
    for first in range(episodes.start, episodes.stop, lanes.num_lanes):
        batch = range(first, first + lanes.num_lanes)
        acting = controller
        if added_noise is not None:
            sigma, key = added_noise
            acting = NoisyController(controller, sigma, [keyed_generator(*key, episode) for episode in batch])
        trajectories += roll_out(
            environment,
            lanes,
            acting,
            reset_seeds=[keyed_seed(*reset_key, episode) for episode in batch],
            noise=[keyed_generator(*noise_key, episode) for episode in batch],
        )
    return trajectories


def check_finite(trajectories: Sequence[Trajectory], place: str) -> None:
    """Refuses episodes with values that are not finite.

    Raises:
        BuildError: names the episode, the array and the step.
    """
    for episode, trajectory in enumerate(trajectories):
        for name in ("rewards", "observations", "actions"):
            array = getattr(trajectory, name)
            rows = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
            if len(rows):
                raise BuildError(
                    f"{place}, episode {episode}: {name} are not finite at step {rows[0]} "
                    f"({array[rows[0]]}); mend the environment"
                )
