"""What one worker does: train a unit's behavior policies, roll them out, publish each part. Idempotent."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.behavior import BehaviorContext, BehaviorSource
from tcmrl_data.canonical import canonical_json, digest, sha256
from tcmrl_data.checkpoints import CheckpointFolder
from tcmrl_data.discovery import plugin
from tcmrl_data.environment import Controller, Environment, Lanes, UniformController
from tcmrl_data.errors import NondeterminismError
from tcmrl_data.manifest import (
    DATA_VERSION,
    SCHEMA_VERSION,
    ArrayRecord,
    FileRecord,
    Identity,
    PartRecord,
    References,
    part_folder,
    read_part_record,
)
from tcmrl_data.provenance import package_versions, provenance
from tcmrl_data.publish import publish_folder
from tcmrl_data.recipe import Recipe
from tcmrl_data.rollout import roll_out
from tcmrl_data.seeding import Purpose, keyed_generator, keyed_seed
from tcmrl_data.snapshot import Snapshot
from tcmrl_data.statistics import statistics
from tcmrl_data.store import array_digests, encode_arrays, pack
from tcmrl_data.tasks import Task
from tcmrl_data.trajectory import Trajectory

Report = Callable[[Mapping[str, Any]], None]
"""Receives `{"kind": "steps", "count"}` and `{"kind": "part", "task", "step", "id"}`."""


@dataclass(frozen=True)
class UnitSpec:
    """What a worker is told; JSON both ways.

    Attributes:
        dataset: folder of the dataset.
        recipe: the resolved recipe.
        seed: root seed of the build.
        tasks: the unit's tasks.
    """

    dataset: Path
    recipe: Recipe
    seed: int
    tasks: tuple[Task, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "dataset": str(self.dataset),
            "recipe": self.recipe.model_dump(mode="json"),
            "seed": self.seed,
            "tasks": [[task.index, task.split, dict(task.parameters)] for task in self.tasks],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "UnitSpec":
        """The inverse of `to_json`."""
        recipe = Recipe.model_validate_json(canonical_json(values["recipe"]))
        tasks = tuple(Task(index, split, parameters) for index, split, parameters in values["tasks"])
        return cls(Path(values["dataset"]), recipe, values["seed"], tasks)


def behavior_source(recipe: Recipe) -> BehaviorSource:
    """The recipe's behavior source with its settings."""
    module = plugin("tcmrl_data.behavior", "behavior source", recipe.behavior["source"])
    source: BehaviorSource = module.Source(
        module.Settings.model_validate_json(canonical_json(recipe.behavior["settings"]))
    )
    return source


def run_unit(spec: UnitSpec, report: Report) -> str:
    """Makes every missing part of the unit's tasks; parts already published are left alone.

    Returns:
        A digest over the ids of the unit's parts.

    Raises:
        NondeterminismError: a published part of the same task and step has another id.
    """
    source = behavior_source(spec.recipe)
    folders = {
        (task.index, step): spec.dataset / part_folder(task.index, step)
        for task in spec.tasks
        for step in source.steps
    }
    if not all((folder / "part.json").is_file() for folder in folders.values()):
        _make_parts(spec, source, report)
    return digest([read_part_record(folder / "part.json").id for folder in folders.values()])


def _make_parts(spec: UnitSpec, source: BehaviorSource, report: Report) -> None:
    environment = spec.recipe.make_environment()
    context = BehaviorContext(
        environment=environment,
        tasks=spec.tasks,
        seed=spec.seed,
        observation=spec.recipe.behavior["observation"],
        reward=spec.recipe.behavior["reward"],
        report=lambda count: report({"kind": "steps", "count": count}),
        checkpoints=lambda task: _checkpoints(spec, source, task),
    )
    with contextlib.ExitStack() as stack:
        rollers: dict[int, _TaskRoller] = {}
        for task, snapshot in source.snapshots(context):
            if task.index not in rollers:
                rollers[task.index] = _TaskRoller(spec, environment, task)
                stack.callback(rollers[task.index].close)
            rollers[task.index].publish(snapshot, report)
            if snapshot.step == source.steps[-1]:
                rollers[task.index].close()
                _checkpoints(spec, source, task).clear()


def _checkpoints(spec: UnitSpec, source: BehaviorSource, task: Task) -> CheckpointFolder:
    """Where the task's training keeps its state; bound to everything that the training depends on."""
    key = {
        "data_version": DATA_VERSION,
        "settings": spec.recipe.unit_settings(),
        "seed": spec.seed,
        "task": task.index,
        "packages": package_versions(),
    }
    missing = [
        step
        for step in source.steps
        if not (spec.dataset / part_folder(task.index, step) / "part.json").is_file()
    ]
    return CheckpointFolder(
        spec.dataset, f"task_{task.index:05d}", key=digest(key), before=min(missing, default=math.inf)
    )


class _TaskRoller:
    """Rolls out and publishes the snapshots of one task, with one set of lanes."""

    def __init__(self, spec: UnitSpec, environment: Environment, task: Task) -> None:
        self.task = task
        self._spec, self._environment = spec, environment
        self._parameters = [task.parameters] * spec.recipe.rollouts.lanes
        self._lanes: Lanes | None = None
        self._references: References | None = None

    def close(self) -> None:
        """Frees the lanes; closing twice does no harm."""
        if self._lanes is not None:
            self._lanes.close()
            self._lanes = None

    def publish(self, snapshot: Snapshot, report: Report) -> str:
        """Publishes the part of a snapshot and returns its id."""
        dataset = self._spec.dataset
        target = dataset / part_folder(self.task.index, snapshot.step)
        if (target / "part.json").is_file():
            record = read_part_record(target / "part.json")
            if record.identity.policy != snapshot.digest():
                raise NondeterminismError(
                    f"{target}: its policy differs from the one trained now with the same seed"
                )
            return record.id
        part_id, files = self._make(snapshot)
        if not publish_folder(dataset, target, files, attempt=f"task_{self.task.index:05d}"):
            published = read_part_record(target / "part.json").id
            if published != part_id:
                raise NondeterminismError(
                    f"{target}: published with id {published}, made again with {part_id}"
                )
        report({"kind": "part", "task": self.task.index, "step": snapshot.step, "id": part_id})
        return part_id

    def _make(self, snapshot: Snapshot) -> tuple[str, dict[str, bytes]]:
        """The id and all files of the snapshot's part."""
        environment, spec = self._environment, self._spec
        if self._lanes is None:
            self._lanes = environment.lanes(self._parameters)
        trajectories = roll_out_part(spec, environment, self.task, snapshot, self._lanes)
        if self._references is None:
            self._references = self._measure_references()
        arrays = pack(trajectories)
        digests = {
            name: ArrayRecord.model_validate_json(canonical_json(each))
            for name, each in array_digests(arrays).items()
        }
        identity = Identity(
            schema_version=SCHEMA_VERSION,
            data_version=DATA_VERSION,
            settings=spec.recipe.unit_settings(),
            task=self.task.index,
            parameters=dict(self.task.parameters),
            step=snapshot.step,
            seed=spec.seed,
            policy=snapshot.digest(),
            arrays=digests,
        )
        files = encode_arrays(arrays) | snapshot.files()
        record = PartRecord(
            schema_version=SCHEMA_VERSION,
            id=digest(identity.model_dump(mode="json")),
            identity=identity,
            statistics=statistics(trajectories),
            references=self._references,
            files={
                name: FileRecord(size=len(data), sha256=sha256(data)) for name, data in sorted(files.items())
            },
            provenance=provenance(environment),
        )
        return record.id, files | {"part.json": canonical_json(record.model_dump(mode="json"))}

    def _measure_references(self) -> References:
        """Uniform, oracle and noise-free scripted returns of the task, from one lane batch each."""
        environment, lanes = self._environment, self._lanes
        assert lanes is not None
        key = (self._spec.seed, environment.name, self.task.index)
        seeds = [keyed_seed(*key, Purpose.REFERENCE_RESET, lane) for lane in range(lanes.num_lanes)]

        def mean_return(controller: Controller | None) -> float | None:
            if controller is None:
                return None
            noise = [keyed_generator(*key, Purpose.REFERENCE_NOISE, lane) for lane in range(lanes.num_lanes)]
            episodes = roll_out(environment, lanes, controller, reset_seeds=seeds, noise=noise)
            return float(np.mean([each.undiscounted_return for each in episodes]))

        uniform = mean_return(UniformController())
        assert uniform is not None
        return References(
            uniform=uniform,
            oracle=mean_return(environment.oracle(self._parameters)),
            scripted=mean_return(environment.scripted(self._parameters, 0.0)),
        )


def part_bytes(recipe: Recipe) -> int:
    """Size of a part's arrays before compression, for episodes of full length."""
    environment = recipe.make_environment()
    row_bytes = 4 * (environment.observation_dim + environment.action_dim + 1) + 2
    return recipe.rollouts.episodes * (environment.settings.horizon + 1) * row_bytes


def roll_out_part(
    spec: UnitSpec, environment: Environment, task: Task, snapshot: Snapshot, lanes: Lanes
) -> list[Trajectory]:
    """The recipe's episodes of one snapshot, in lane batches; each episode has its own keyed seeds."""
    controller = snapshot.controller(environment, [task.parameters] * lanes.num_lanes)
    return [
        trajectory
        for first in range(0, spec.recipe.rollouts.episodes, lanes.num_lanes)
        for trajectory in _roll_out_batch(spec, environment, task, snapshot.step, lanes, controller, first)
    ]


def _roll_out_batch(
    spec: UnitSpec,
    environment: Environment,
    task: Task,
    step: int,
    lanes: Lanes,
    controller: Controller,
    first: int,
) -> Iterator[Trajectory]:
    key = (spec.seed, environment.name, task.index)
    episodes = range(first, first + lanes.num_lanes)
    yield from roll_out(
        environment,
        lanes,
        controller,
        reset_seeds=[keyed_seed(*key, Purpose.ROLLOUT_RESET, step, episode) for episode in episodes],
        noise=[keyed_generator(*key, Purpose.ROLLOUT_NOISE, step, episode) for episode in episodes],
    )
