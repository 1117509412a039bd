"""Parts made from stored ones in worker processes."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.engine.base import ENGINES, Unit
from tcmrl_data.engine.local import Send
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.records import as_model, digest, from_json, to_json
from tcmrl_data.parts.making import NO_REFERENCES, Published, make_from, one_thread, publish, wanted_from
from tcmrl_data.parts.operation import Operation, Simulator, StoredPart
from tcmrl_data.parts.own_operations import operation_named
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.part import References
from tcmrl_data.store.part_table import REFERENCES
from tcmrl_data.store.tables import PartKey

WORKER = "tcmrl_data.parts.jobs"
UNITS_PER_WORKER = 4
"""Starting a process takes seconds, a part often less; few units balance well enough."""


@dataclass(frozen=True)
class Job:
    """A part that is to be made from another one."""

    source: PartKey
    key: PartKey


@dataclass(frozen=True)
class DeriveSpec:
    """What a worker is told, as JSON.

    Attributes:
        out: folder where parts are published; may be the same one.
        settings: what the settings of all its parts have in common.
        seed: root seed of the parts that are read, and of the new ones; None where it is not known.
    """

    source: Path
    out: Path
    operation: str
    settings: Mapping[str, Any]
    recipe: Recipe
    seed: int | None
    jobs: tuple[Job, ...]

    def operation_on(self, dataset: Dataset, source: PartKey) -> Operation[Any]:
        """The operation with the settings of the part that is made from `source`."""
        kind = operation_named(self.operation)
        settings = kind.settings_for(self.settings, dataset.task(source.task))
        return kind(as_model(kind.Settings, settings))

    def units(self, workers: int) -> list[Unit]:
        """The jobs in units of whole tasks, a few for every worker."""
        tasks = sorted({job.key.task for job in self.jobs})
        size = -(-len(tasks) // (UNITS_PER_WORKER * workers)) or 1
        units = []
        for start in range(0, len(tasks), size):
            chosen = set(tasks[start : start + size])
            jobs = tuple(job for job in self.jobs if job.key.task in chosen)
            spec = dataclasses.replace(self, source=self.source.resolve(), out=self.out.resolve(), jobs=jobs)
            name = f"tasks {min(chosen)} to {max(chosen)}"
            units.append(Unit(name, to_json(spec), WORKER, cost=float(len(jobs))))
        return units


def derive_parts(
    spec: DeriveSpec, *, workers: int | None, progress: Callable[[int, int], None] | None = None
) -> list[Published]:
    """Makes and publishes the parts of all jobs; parts that are there already are read and left alone.

    Returns:
        The parts, sorted by key.

    Raises:
        BuildError: a part cannot be made, or a worker crashed; what was published stands.
    """
    engine = ENGINES.get("local")(workers)
    parts: dict[PartKey, Published] = {}
    errors: list[str] = []

    def take_in(unit: str, message: Mapping[str, Any]) -> None:
        if message["kind"] == "part":
            published = Published.from_message(message)
            parts[published.entry.key] = published
            if progress is not None:
                progress(len(parts), len(spec.jobs))

    with contextlib.closing(engine.run(spec.units(workers or available_cores()), take_in)) as results:
        for result in results:
            if result.error is not None:
                errors.append(result.error)
                break
    missing = sorted({job.key for job in spec.jobs} - parts.keys())
    if errors or missing:
        raise BuildError(errors[0] if errors else f"{spec.out}: the part of {missing[0]} was not made")
    return [parts[key] for key in sorted(parts)]


def work(values: dict[str, Any], report: Send) -> str:
    """Makes every missing part of some jobs, those of a task with one simulator; the digest of all ids."""
    spec = from_json(DeriveSpec, values)
    dataset, ids = open_dataset(spec.source), []
    with one_thread():
        for index in sorted({job.key.task for job in spec.jobs}):
            with contextlib.ExitStack() as stack:
                simulator = None
                if operation_named(spec.operation).simulates:
                    assert spec.seed is not None  # the driver saw to it
                    simulator = Simulator(spec.recipe, seed=spec.seed, task=dataset.task(index))
                    stack.callback(simulator.close)
                for job in spec.jobs:
                    if job.key.task == index:
                        published = _publish(spec, dataset, job, simulator)
                        report(published.to_message())
                        ids.append(published.entry.id)
    return digest(ids)


def _publish(spec: DeriveSpec, dataset: Dataset, job: Job, simulator: Simulator | None) -> Published:
    operation, source = spec.operation_on(dataset, job.source), StoredPart.of(dataset, job.source)
    task, references = dataset.task(job.key.task), references_of(dataset, job.key.task)
    wanted = wanted_from(operation, source, task=task, simulator=simulator)
    make = functools.partial(
        make_from, operation, source, task=task, simulator=simulator, references=references
    )
    return publish(spec.out, job.key, make, wanted=wanted)


def references_of(dataset: Dataset, task: int) -> References:
    """The reference returns that a dataset has for a task."""
    entries = dataset.parts.entries_of(task)
    if not entries:
        return NO_REFERENCES
    return References(**{name: getattr(entries[0], name) for name in REFERENCES})
