"""What one worker does: train a unit's behavior policies, roll them out, publish the parts. Idempotent."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from tcmrl_data.behavior.base import (
    CHECKPOINT_SECONDS,
    BehaviorContext,
    BehaviorSource,
    CheckpointFolder,
    Snapshot,
    checkpoint_name,
)
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.engine.worker import Send
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.errors import NondeterminismError
from tcmrl_data.foundation.records import as_model
from tcmrl_data.parts.making import Published, make_part, one_thread, publish, read_published
from tcmrl_data.parts.operation import Simulator, Sources, WantedPart
from tcmrl_data.parts.own_operations import Rollout, measure_references
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.part import DATA_VERSION, PartRecord, References, read_part_record
from tcmrl_data.store.tables import MAIN_RUN, PartKey, part_file


@dataclass(frozen=True)
class UnitSpec:
    """What a worker is told; JSON both ways.

    Attributes:
        dataset: folder of the dataset.
        recipe: the resolved recipe.
        seed: root seed of the build.
        tasks: the unit's tasks, which are trained together.
        dropped: indices of tasks of which no parts are made.
        checkpoint_seconds: least time between two checkpoints of behavior training.
    """

    dataset: Path
    recipe: Recipe
    seed: int
    tasks: tuple[Task, ...]
    dropped: frozenset[int] = frozenset()
    checkpoint_seconds: float = CHECKPOINT_SECONDS

    def to_json(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "dataset": str(self.dataset),
            "recipe": self.recipe.model_dump(mode="json"),
            "seed": self.seed,
            "tasks": [[task.index, task.split, dict(task.parameters)] for task in self.tasks],
            "dropped": sorted(self.dropped),
            "checkpoint_seconds": self.checkpoint_seconds,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "UnitSpec":
        """The inverse of `to_json`."""
        recipe = as_model(Recipe, values["recipe"])
        tasks = tuple(Task(index, split, parameters) for index, split, parameters in values["tasks"])
        dropped = frozenset(values["dropped"])
        return cls(
            Path(values["dataset"]), recipe, values["seed"], tasks, dropped, values["checkpoint_seconds"]
        )


def run_unit(spec: UnitSpec, report: Send) -> str:
    """Makes every missing part of the unit's tasks; parts already published are left alone.

    Returns:
        A digest over the ids of the unit's parts.

    Raises:
        NondeterminismError: a part published on an equal platform has another policy.
    """
    plan = BuildPlan.of_tasks(spec.recipe, seed=spec.seed, tasks=spec.tasks, dropped=spec.dropped)
    missing = {task.index: _missing_steps(spec, plan.source, task) for task in plan.wanted}
    missing = {index: steps for index, steps in missing.items() if steps}
    if missing:
        _make_parts(spec, plan, missing, report)
    keys = [PartKey(task.index, step) for task in plan.wanted for step in plan.source.steps]
    return digest([_part_id(spec.dataset / part_file(key)) for key in keys])


@final
class PartMaker:
    """Rolls out and publishes the snapshots of one task, with one simulator.

    Args:
        dataset: its folder.
        plan: of the build.
        task: whose snapshots these are.
        behavior: what the behavior source records with its parts.
    """

    def __init__(self, dataset: Path, plan: BuildPlan, *, task: Task, behavior: Mapping[str, Any]) -> None:
        self._dataset, self._behavior = dataset, behavior
        self._simulator = Simulator(
            plan.recipe, seed=plan.seed, task=task, environment=plan.environment, platform=plan.platform
        )
        self._references: References | None = None

    def close(self) -> None:
        """Frees the simulator; closing twice does no harm."""
        self._simulator.close()

    def publish(self, snapshot: Snapshot) -> Published | None:
        """Publishes the part of a snapshot; one that is there already is left alone, and None is returned.

        Raises:
            NondeterminismError: the part that is there was made on an equal platform from another policy.
        """
        simulator = self._simulator
        key = PartKey(simulator.task.index, snapshot.step)
        file = self._dataset / part_file(key)
        if not file.exists():
            return publish(self._dataset, key, lambda: self._make(snapshot))
        _, record = read_published(file, MAIN_RUN)
        same_platform = record.platform.digest() == simulator.platform.digest()
        if same_platform and record.identity.policy != snapshot.digest():
            raise NondeterminismError(
                f"{file}: its policy differs from the one trained now with the same seed"
            )
        return None

    def _make(self, snapshot: Snapshot) -> tuple[PartRecord, bytes]:
        simulator = self._simulator
        settings = simulator.recipe.unit_settings()
        wanted = WantedPart(settings, simulator.task, snapshot.step, simulator.seed, snapshot)
        episodes = Rollout().make(wanted, Sources(simulator))
        if self._references is None:
            self._references = measure_references(simulator)
        return make_part(
            wanted,
            episodes,
            references=self._references,
            behavior=self._behavior,
            platform=simulator.platform,
        )


def _part_id(file: Path) -> str:
    with Archive(file) as archive:
        return read_part_record(archive).id


def _make_parts(spec: UnitSpec, plan: BuildPlan, missing: Mapping[int, Sequence[int]], report: Send) -> None:
    """Makes the missing snapshot steps, by task index."""
    source = plan.source
    context = BehaviorContext(
        environment=plan.environment,
        tasks=spec.tasks,
        seed=spec.seed,
        observation=spec.recipe.behavior.observation,
        reward=spec.recipe.behavior.reward,
        report=lambda count: report({"kind": "steps", "count": count}),
        checkpoints=lambda tasks: _checkpoints(spec, plan, tasks, missing, report),
    )
    recorded = source.provenance()
    with contextlib.ExitStack() as stack:
        makers: dict[int, PartMaker] = {}
        for task, snapshot in source.snapshots(context):
            if task.index not in missing:
                continue
            if task.index not in makers:
                makers[task.index] = PartMaker(spec.dataset, plan, task=task, behavior=recorded)
                stack.callback(makers[task.index].close)
            published = makers[task.index].publish(snapshot)
            if published is not None:
                report(published.to_message())
            # simulators of many tasks would fill the memory: a group makes them anew for every part
            if snapshot.step == source.steps[-1] or len(missing) > 1:
                makers[task.index].close()
    _checkpoints(spec, plan, spec.tasks, missing, report).clear()


def _missing_steps(spec: UnitSpec, source: BehaviorSource, task: Task) -> list[int]:
    """Snapshot steps of the task that have no published part."""
    return [
        step for step in source.steps if not (spec.dataset / part_file(PartKey(task.index, step))).exists()
    ]


def _checkpoints(
    spec: UnitSpec,
    plan: BuildPlan,
    tasks: Sequence[Task],
    missing: Mapping[int, Sequence[int]],
    report: Send,
) -> CheckpointFolder:
    """Where the tasks' training keeps its state; bound to everything that the training depends on."""
    key = {
        "data_version": DATA_VERSION,
        "settings": spec.recipe.unit_settings(),
        "seed": spec.seed,
        "tasks": [task.index for task in tasks],
        "platform": plan.platform.digest(),
    }
    return CheckpointFolder(
        spec.dataset,
        checkpoint_name(tasks),
        key=digest(key),
        missing={task.index: missing[task.index][0] for task in tasks if task.index in missing},
        seconds=spec.checkpoint_seconds,
        warn=lambda message: report({"kind": "warning", "message": message}),
    )


def work(spec: dict[str, Any], report: Send) -> str:
    """Makes and publishes the parts of a unit; the digest of their ids."""
    with one_thread():
        return run_unit(UnitSpec.from_json(spec), report)
