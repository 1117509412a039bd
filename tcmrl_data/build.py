"""Building a dataset: choose tasks, run units on an engine, keep the manifest true after every part."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tcmrl_data.canonical import sha256
from tcmrl_data.discovery import plugin
from tcmrl_data.engine import BaseEngine, Result, Unit
from tcmrl_data.errors import BuildError, StoreError
from tcmrl_data.manifest import (
    DATA_VERSION,
    MANIFEST,
    SCHEMA_VERSION,
    PartEntry,
    PartRecord,
    TaskReferences,
    merkle_root,
    part_folder,
    read_manifest,
    read_part_record,
    seal,
)
from tcmrl_data.publish import (
    CHECKPOINTS,
    LOCK,
    STAGING,
    lock_file,
    remove_abandoned,
    replace_file,
    write_file,
)
from tcmrl_data.recipe import Recipe
from tcmrl_data.store import GROUP, check_layout
from tcmrl_data.tasks import Task, choose_tasks
from tcmrl_data.unit import UnitSpec, behavior_source

MANIFEST_SECONDS = 1.0
"""The manifest is rewritten at most this often while parts arrive, and at the end."""

OWN_FILES = {MANIFEST, LOCK, STAGING, CHECKPOINTS, "zarr.json", "tasks"}


@dataclass(frozen=True)
class BuildEvent:
    """How far a build is.

    Attributes:
        kind: what just happened.
        steps_done: environment steps of behavior training done; a resumed task starts again at zero.
        message: for people.
    """

    kind: Literal["start", "steps", "part", "unit_done", "unit_failed"]
    tasks_done: int
    tasks_total: int
    parts_done: int
    parts_total: int
    steps_done: int
    steps_total: int
    message: str


@dataclass(frozen=True)
class BuildReport:
    """What a build did.

    Attributes:
        built: parts made now.
        present: parts that were there and whose digests held.
        failed: one line per task that failed.
        root: Merkle root of the dataset as it now stands.
    """

    dataset: Path
    built: int
    present: int
    failed: tuple[str, ...]
    seconds: float
    root: str


def build_dataset(
    recipe: Recipe,
    out: Path,
    *,
    seed: int = 0,
    tasks: Sequence[int] | None = None,
    workers: int | None = None,
    engine: str = "local",
    progress: Callable[[BuildEvent], None] = lambda event: None,
) -> BuildReport:
    """Builds what is missing of a dataset; on a finished one it verifies and changes nothing.

    Args:
        recipe: what to build.
        out: dataset folder: new, empty, or a dataset of the same recipe and seed, which is extended.
        seed: root seed of behavior training and rollouts.
        tasks: indices of the full task set instead of the profile's choice.
        workers: units run at the same time; the number of cores where None.
        engine: an engine's name.
        progress: called as the build goes on.

    Raises:
        BuildError: `out` is no dataset, or one of other settings or another seed.
        LockedError: another process builds this dataset.
        StoreError: a published part is damaged.
    """
    started = time.monotonic()
    runner: BaseEngine = plugin("tcmrl_data.engine", "engine", engine).Engine(workers or os.cpu_count() or 1)
    chosen = choose_tasks(recipe, tasks)
    _check_folder(out, recipe, seed)
    out.mkdir(parents=True, exist_ok=True)
    with lock_file(out / LOCK, f"dataset {out}"):
        remove_abandoned(out)
        driver = _Driver(recipe, out, seed, chosen, progress)
        present = len(driver.parts)
        failed = driver.run(runner)
        root = driver.write_manifest()
    return BuildReport(out, len(driver.parts) - present, present, failed, time.monotonic() - started, root)


class _Driver:
    """The one writer of a dataset's manifest."""

    def __init__(
        self,
        recipe: Recipe,
        out: Path,
        seed: int,
        tasks: Sequence[Task],
        progress: Callable[[BuildEvent], None],
    ) -> None:
        self._recipe, self._out, self._seed, self._progress = recipe, out, seed, progress
        self._source = behavior_source(recipe)
        self._tasks = {task.index: task for task in [*_earlier_tasks(out, recipe), *tasks]}
        self.parts: dict[tuple[int, int], PartRecord] = {}
        self._entries: dict[tuple[int, int], PartEntry] = {}
        for index in self._tasks:
            for step in self._source.steps:
                if (out / part_folder(index, step)).is_dir():
                    self._take_in(index, step)
        self._steps_done = 0
        self._written = 0.0

    def run(self, engine: BaseEngine) -> tuple[str, ...]:
        """Runs the units that have missing parts; returns one line per failure."""
        missing = [task for task in self._tasks.values() if not self._is_done(task.index)]
        units = [self._unit(task) for task in sorted(missing, key=lambda task: task.index)]
        self._steps_total = self._source.training_steps * len(units)
        _make_groups(self._out, missing)
        self._tell("start", f"{len(missing)} of {len(self._tasks)} tasks to build")
        failures = []
        for result in engine.run(units, self._on_message):
            if result.ok:
                self._tell("unit_done", f"{result.id} done")
            else:
                failures.append(_failure(result))
                self._tell("unit_failed", failures[-1])
        return tuple(sorted(failures))

    def _unit(self, task: Task) -> Unit:
        spec = UnitSpec(self._out.resolve(), self._recipe, self._seed, (task,))
        return Unit(f"task {task.index}", spec.to_json(), cost=self._source.training_steps)

    def _is_done(self, index: int) -> bool:
        return all((index, step) in self.parts for step in self._source.steps)

    def _on_message(self, unit: str, message: Mapping[str, Any]) -> None:
        if message["kind"] == "steps":
            self._steps_done += message["count"]
            self._tell("steps", unit)
            return
        self._take_in(message["task"], message["step"])
        if time.monotonic() - self._written > MANIFEST_SECONDS:
            self.write_manifest()
        self._tell("part", f"{unit}, step {message['step']}")

    def _take_in(self, task: int, step: int) -> None:
        """Checks a published part by its digests and adds it to the manifest."""
        folder = self._out / part_folder(task, step)
        self.parts[task, step] = record = check_part(folder)
        sealed = sha256((folder / "part.json").read_bytes())
        if (record.identity.task, record.identity.step, record.identity.seed) != (task, step, self._seed):
            raise StoreError(f"{folder}: holds another part; delete the folder and build again")
        if record.identity.settings != self._recipe.unit_settings():
            raise StoreError(f"{folder}: was built with other settings; delete the folder and build again")
        self._entries[task, step] = PartEntry(task=task, step=step, id=record.id, sha256=sealed)

    def write_manifest(self) -> str:
        """Writes the manifest from the parts, unless it stands there already; returns the root."""
        entries = [self._entries[key] for key in sorted(self._entries)]
        tasks = [self._tasks[index] for index in sorted(self._tasks)]
        fields = {
            "schema_version": SCHEMA_VERSION,
            "name": self._recipe.environment["name"],
            "data_version": DATA_VERSION,
            "seed": self._seed,
            "recipe": self._recipe.model_dump(mode="json"),
            "steps": list(self._source.steps),
            "tasks": [{"index": t.index, "split": t.split, "parameters": dict(t.parameters)} for t in tasks],
            "parts": [entry.model_dump(mode="json") for entry in entries],
            "root": merkle_root(entries),
            "complete": all(self._is_done(index) for index in self._tasks),
            "references": {
                str(index): self._references(index).model_dump(mode="json")
                for index in sorted(self._tasks)
                if self._is_done(index)
            },
        }
        data, file = seal(fields), self._out / MANIFEST
        if not file.is_file() or file.read_bytes() != data:
            replace_file(self._out, MANIFEST, data, staging=self._out / STAGING)
        self._written = time.monotonic()
        return str(fields["root"])

    def _references(self, index: int) -> TaskReferences:
        records = [self.parts[index, step] for step in self._source.steps]
        best = max(record.statistics.mean for record in records)
        return TaskReferences(**records[0].references.model_dump(), behavior=best)

    def _tell(
        self, kind: Literal["start", "steps", "part", "unit_done", "unit_failed"], message: str
    ) -> None:
        self._progress(
            BuildEvent(
                kind=kind,
                tasks_done=sum(self._is_done(index) for index in self._tasks),
                tasks_total=len(self._tasks),
                parts_done=len(self.parts),
                parts_total=len(self._tasks) * len(self._source.steps),
                steps_done=self._steps_done,
                steps_total=self._steps_total,
                message=message,
            )
        )


def check_part(folder: Path) -> PartRecord:
    """The record of a published part whose files all have their recorded sizes and digests.

    Raises:
        StoreError: names the file that is missing, changed or added.
    """
    record = read_part_record(folder / "part.json")
    check_layout(folder, {name: each.model_dump() for name, each in record.identity.arrays.items()})
    for name, expected in record.files.items():
        file = folder / name
        if not file.is_file() or file.is_symlink() or sha256(file.read_bytes()) != expected.sha256:
            raise StoreError(f"{file} is missing or damaged; delete {folder} and build again")
    return record


def _failure(result: Result) -> str:
    return f"{result.id} failed after {result.attempt} attempt(s) on {result.node}: {result.error}"


def _check_folder(out: Path, recipe: Recipe, seed: int) -> None:
    """Refuses a folder that is neither new nor a dataset of this recipe and seed."""
    if not out.exists():
        return
    if not out.is_dir() or {entry.name for entry in out.iterdir()} - OWN_FILES:
        raise BuildError(f"--out {out} exists and is no dataset; choose another folder")
    if not (out / MANIFEST).is_file():
        return
    manifest = read_manifest(out)
    if manifest.data_version != DATA_VERSION:
        raise BuildError(
            f"{out} has data version {manifest.data_version}, not {DATA_VERSION}; use another --out"
        )
    if manifest.seed != seed:
        raise BuildError(f"{out} was built with seed {manifest.seed}, not {seed}; use another --out")
    other = _first_difference(manifest.recipe.unit_settings(), recipe.unit_settings())
    if other:
        raise BuildError(f"{out} was built with other settings: {other}; use another --out")


def _first_difference(old: Any, new: Any, path: str = "") -> str | None:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            found = _first_difference(old.get(key), new.get(key), f"{path}.{key}" if path else key)
            if found:
                return found
        return None
    return None if old == new else f"{path} is {old} there and {new} here"


def _earlier_tasks(out: Path, recipe: Recipe) -> list[Task]:
    """Tasks that the dataset already has, built or planned."""
    if not (out / MANIFEST).is_file():
        return []
    return choose_tasks(recipe, [task.index for task in read_manifest(out).tasks])


def _make_groups(out: Path, tasks: Sequence[Task]) -> None:
    """Makes the folders above the parts groups of one Zarr hierarchy."""
    folders = [out, out / "tasks"]
    for task in tasks:
        snapshots = (out / part_folder(task.index, 0)).parent
        folders += [snapshots.parent, snapshots]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "zarr.json").is_file():
            write_file(folder / "zarr.json", GROUP)
