"""New parts from stored ones by the simulator, made in worker processes."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.building.published import Published
from tcmrl_data.engine.base import ENGINES, Unit
from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.keys import PartKey

WORKER = "tcmrl_data.operations.worker"
UNITS_PER_WORKER = 4
"""Starting a process takes seconds, a part often less; few units balance well enough."""


@dataclass(frozen=True)
class Job:
    """A part that is to be made from another one.

    Attributes:
        source: the other part.
        key: of the new part.
    """

    source: PartKey
    key: PartKey


@dataclass(frozen=True)
class RemakeSpec:
    """What a worker is told; JSON both ways.

    Attributes:
        source: folder of the dataset that is read.
        out: folder where parts are published; may be the same one.
        operation: `extend` or `relabel`.
        settings: of the operation.
        recipe: that the new parts go by.
        seed: root seed of the parts that are read, and of the new ones.
        jobs: the parts to make.
    """

    source: Path
    out: Path
    operation: str
    settings: Mapping[str, Any]
    recipe: Recipe
    seed: int
    jobs: tuple[Job, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "source": str(self.source),
            "out": str(self.out),
            "operation": self.operation,
            "settings": dict(self.settings),
            "recipe": self.recipe.model_dump(mode="json"),
            "seed": self.seed,
            "jobs": [[list(job.source), list(job.key)] for job in self.jobs],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "RemakeSpec":
        """The inverse of `to_json`."""
        return cls(
            Path(values["source"]),
            Path(values["out"]),
            values["operation"],
            values["settings"],
            Recipe.model_validate_json(canonical_json(values["recipe"])),
            values["seed"],
            tuple(Job(PartKey(*source), PartKey(*key)) for source, key in values["jobs"]),
        )

    def units(self, workers: int) -> list[Unit]:
        """The jobs in units of whole tasks, a few for every worker."""
        tasks = sorted({job.key.task for job in self.jobs})
        size = -(-len(tasks) // (UNITS_PER_WORKER * workers)) or 1
        units = []
        for start in range(0, len(tasks), size):
            chosen = set(tasks[start : start + size])
            jobs = tuple(job for job in self.jobs if job.key.task in chosen)
            spec = dataclasses.replace(self, jobs=jobs)
            name = f"tasks {min(chosen)} to {max(chosen)}"
            units.append(Unit(name, spec.to_json(), WORKER, cost=float(len(jobs))))
        return units


def remake_parts(
    spec: RemakeSpec, *, workers: int | None, progress: Callable[[int, int], None]
) -> list[Published]:
    """Makes and publishes the parts of all jobs; parts that are there already are read and left alone.

    Args:
        spec: what to make.
        workers: processes at the same time; one per core where None.
        progress: called with parts done and parts in all.

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
