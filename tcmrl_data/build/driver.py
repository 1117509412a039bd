"""The one writer of a dataset's manifest: runs units and takes in what they publish."""

import contextlib
import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tcmrl_data.build.events import BuildEvent, EventKind, EventLog
from tcmrl_data.build.plan import BuildPlan
from tcmrl_data.build.unit import UnitSpec
from tcmrl_data.engine.base import BaseEngine, Result, Unit
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.canonical import sha256
from tcmrl_data.foundation.disk import STAGING, make_folders, replace_file
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.store.layout import GROUP, check_layout
from tcmrl_data.store.manifest import (
    DATA_VERSION,
    MANIFEST,
    SCHEMA_VERSION,
    PartEntry,
    PartRecord,
    TaskReferences,
    merkle_root,
    part_folder,
    read_part_record,
    seal,
)

WORKER = "tcmrl_data.build.worker"
"""Module that does a unit."""

MANIFEST_SECONDS = 1.0
"""The manifest is rewritten at most this often while parts arrive, and at the end."""


class Driver:
    """The one writer of a dataset's manifest.

    Args:
        plan: what to build.
        out: the dataset's folder; its published parts are checked and taken in.

    Raises:
        StoreError: a published part is damaged, or is not of the plan.
    """

    def __init__(self, plan: BuildPlan, out: Path) -> None:
        self._plan, self._out, self._source = plan, out, plan.source
        self._tasks = {task.index: task for task in plan.tasks}
        self.parts: dict[tuple[int, int], PartRecord] = {}
        self._entries: dict[tuple[int, int], PartEntry] = {}
        for index in self._tasks:
            for step in self._source.steps:
                if (out / part_folder(index, step)).is_dir():
                    self._take_in(index, step)
        self._steps_done = self._steps_total = 0
        self._written = 0.0
        self.root = ""

    @property
    def missing_parts(self) -> int:
        """Parts that are still to be made."""
        return len(self._tasks) * len(self._source.steps) - len(self.parts)

    def run(self, engine: BaseEngine, log: EventLog) -> tuple[str, ...]:
        """Runs the units that have missing parts; returns one line per failure.

        However it ends, the manifest then names every part that was taken in.
        """
        missing = [task for task in self._tasks.values() if not self._is_done(task.index)]
        groups = [
            group for group in self._plan.groups if not all(self._is_done(task.index) for task in group)
        ]
        tasks_of = {_unit_id(group): group for group in groups}
        units = [self._unit(group) for group in groups]
        self._steps_total = self._source.training_steps * sum(len(group) for group in groups)
        make_groups(self._out, missing)
        failures: list[str] = []
        try:
            self.write_manifest()
            log.write(self._event("start", f"{len(missing)} of {len(self._tasks)} tasks to build"))
            results = engine.run(units, lambda unit, message: self._on_message(unit, message, log))
            with contextlib.closing(results):
                for result in results:
                    for task in tasks_of[result.id]:
                        self._take_in_published(task.index)
                    missing_parts = self._missing_parts(tasks_of[result.id]) if result.ok else ()
                    if missing_parts:
                        result = dataclasses.replace(result, ok=False, error=_without(missing_parts))
                    if result.ok:
                        log.write(self._event("unit_done", f"{result.id} done", result.id))
                    else:
                        failures.append(_failure(result))
                        log.write(self._event("unit_failed", failures[-1], result.id))
        except KeyboardInterrupt:
            for task in missing:
                self._take_in_published(task.index)
            raise
        finally:
            self.write_manifest()
            log.write(self._event("end", f"{len(self.parts)} parts, {len(failures)} units failed"))
        return tuple(sorted(failures))

    def _unit(self, tasks: tuple[Task, ...]) -> Unit:
        """The unit of a group; done tasks stay in it, since a group's composition may change rounding."""
        spec = UnitSpec(self._out.resolve(), self._plan.recipe, self._plan.seed, tasks)
        reserved = self._plan.recipe.build
        return Unit(
            _unit_id(tasks),
            spec.to_json(),
            WORKER,
            cost=self._source.training_steps * len(tasks),
            cpus=reserved.cpus,
            gpus=reserved.gpus,
            memory=max(reserved.memory, self._plan.unit_bytes(len(tasks))),
            timeout=reserved.timeout,
        )

    def _is_done(self, index: int) -> bool:
        return all((index, step) in self.parts for step in self._source.steps)

    def _missing_parts(self, tasks: Sequence[Task]) -> list[str]:
        """Folders of the tasks' parts that are not published."""
        keys = ((task.index, step) for task in tasks for step in self._source.steps)
        return [part_folder(*key) for key in keys if key not in self.parts]

    def _on_message(self, unit: str, message: Mapping[str, Any], log: EventLog) -> None:
        if message["kind"] == "steps":
            self._steps_done += message["count"]
            log.write(self._event("steps", unit, unit))
            return
        if message["kind"] == "warning":
            log.write(self._event("warning", f"{unit}: {message['message']}", unit))
            return
        self._take_in(message["task"], message["step"])
        if time.monotonic() - self._written > MANIFEST_SECONDS:
            self.write_manifest()
        log.write(self._event("part", f"{unit}, step {message['step']}", unit))

    def _take_in_published(self, index: int) -> None:
        """Takes in a task's parts whose messages were lost, with the worker that published them."""
        for step in self._source.steps:
            known = (index, step) in self.parts
            if not known and (self._out / part_folder(index, step) / "part.json").is_file():
                self._take_in(index, step)

    def _take_in(self, task: int, step: int) -> None:
        """Checks a published part by its digests and adds it to the manifest."""
        folder = self._out / part_folder(task, step)
        self.parts[task, step] = record = check_part(folder)
        sealed = sha256((folder / "part.json").read_bytes())
        found = record.identity
        if (found.task, found.step, found.seed) != (task, step, self._plan.seed):
            raise StoreError(f"{folder}: holds another part; run `tcmrl-data repair`")
        if record.identity.settings != self._plan.recipe.unit_settings():
            raise StoreError(f"{folder}: was built with other settings; run `tcmrl-data repair`")
        self._entries[task, step] = PartEntry(task=task, step=step, id=record.id, sha256=sealed)

    def is_finished(self) -> bool:
        """No part is missing, and the manifest says so."""
        return not self.missing_parts and self._is_written(self._manifest())

    def write_manifest(self) -> None:
        """Writes the manifest from the parts, unless it stands there already."""
        data = self._manifest()
        if not self._is_written(data):
            replace_file(self._out / MANIFEST, data, staging=self._out / STAGING)
        self._written = time.monotonic()

    def _is_written(self, data: bytes) -> bool:
        file = self._out / MANIFEST
        return file.is_file() and file.read_bytes() == data

    def _manifest(self) -> bytes:
        """The manifest of the parts; sets the root."""
        entries = [self._entries[key] for key in sorted(self._entries)]
        self.root = merkle_root(entries)
        tasks = [self._tasks[index] for index in sorted(self._tasks)]
        fields = {
            "schema_version": SCHEMA_VERSION,
            "name": self._plan.environment.name,
            "data_version": DATA_VERSION,
            "seed": self._plan.seed,
            "recipe": self._plan.recipe.model_dump(mode="json"),
            "steps": list(self._source.steps),
            "tasks": [{"index": t.index, "split": t.split, "parameters": dict(t.parameters)} for t in tasks],
            "parts": [entry.model_dump(mode="json") for entry in entries],
            "root": self.root,
            "complete": all(self._is_done(index) for index in self._tasks),
            "references": {
                str(index): self._references(index).model_dump(mode="json")
                for index in sorted(self._tasks)
                if self._is_done(index)
            },
        }
        return seal(fields)

    def _references(self, index: int) -> TaskReferences:
        records = [self.parts[index, step] for step in self._source.steps]
        best = max(record.statistics.mean for record in records)
        return TaskReferences(**records[0].references.model_dump(), behavior=best)

    def _event(self, kind: EventKind, message: str, unit: str | None = None) -> BuildEvent:
        return BuildEvent(
            kind=kind,
            unit=unit,
            tasks_done=sum(self._is_done(index) for index in self._tasks),
            tasks_total=len(self._tasks),
            parts_done=len(self.parts),
            parts_total=len(self._tasks) * len(self._source.steps),
            steps_done=self._steps_done,
            steps_total=self._steps_total,
            message=message,
        )


def check_part(folder: Path) -> PartRecord:
    """The record of a published part whose files all have their recorded sizes and digests.

    Raises:
        StoreError: names the file that is missing, changed or added.
    """
    record = read_part_record(folder / "part.json")
    check_layout(folder, {name: array.model_dump() for name, array in record.identity.arrays.items()})
    for name, expected in record.files.items():
        file = folder / name
        if not file.is_file() or file.is_symlink() or sha256(file.read_bytes()) != expected.sha256:
            raise StoreError(f"{file} is missing or damaged; run `tcmrl-data repair`")
    return record


def _unit_id(tasks: Sequence[Task]) -> str:
    first, last = tasks[0].index, tasks[-1].index
    return f"task {first}" if len(tasks) == 1 else f"{len(tasks)} tasks from {first} to {last}"


def _without(places: Sequence[str]) -> str:
    return f"it ended without {len(places)} of its parts, the first is {places[0]}"


def _failure(result: Result) -> str:
    return f"{result.id} failed after {result.attempt} attempt(s) on {result.node}: {result.error}"


def make_groups(out: Path, tasks: Sequence[Task]) -> None:
    """Makes the folders above the parts groups of one Zarr hierarchy."""
    folders = [out, out / "tasks"]
    for task in tasks:
        snapshots = (out / part_folder(task.index, 0)).parent
        folders += [snapshots.parent, snapshots]
    for folder in folders:
        make_folders(folder)
        if not (folder / "zarr.json").is_file():
            replace_file(folder / "zarr.json", GROUP, staging=out / STAGING)
