"""Building a dataset: choose tasks, refuse what cannot work, run units on an engine, keep what is done."""

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.behavior.base import CHECKPOINT_SECONDS
from tcmrl_data.building.ledger import Ledger
from tcmrl_data.building.plan import UnitSpec, plan_build
from tcmrl_data.building.work_files import (
    ASSEMBLY,
    WORK_FILES,
    WORK_FOLDERS,
    BuildEvent,
    EventKind,
    StatusFile,
    check_work_files,
)
from tcmrl_data.engine.base import BaseEngine, Result, Unit, make_engine
from tcmrl_data.envs.base import ENVIRONMENTS, Task
from tcmrl_data.envs.own import check_environment
from tcmrl_data.foundation.disk import LOCK, lock_file, make_folders, remove_abandoned
from tcmrl_data.foundation.errors import BuildError, ReadOnlyError, StorageError
from tcmrl_data.foundation.files import VISIBLE_SECONDS
from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.records import differences, to_json
from tcmrl_data.parts.making import Published
from tcmrl_data.recipe.recipe import Recipe, full_settings
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, read_manifest
from tcmrl_data.store.part import DATA_VERSION
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, TASKS, PartKey, part_file

SEEDS = 2**63
"""Seeds are stored as int64, in exports too."""

OWN_FILES = {MANIFEST, TASKS, PARTS_TABLE, PARTS} | WORK_FILES | WORK_FOLDERS


@dataclass(frozen=True)
class BuildReport:
    """What a build did.

    Attributes:
        present: parts that were there, with the recorded sizes.
        read_only: the folder cannot be written, and nothing had to be.
    """

    dataset: Path
    built: int
    present: int
    failed: tuple[str, ...]
    seconds: float
    root: str
    read_only: bool


def build_dataset(
    recipe: Recipe,
    out: Path,
    *,
    seed: int = 0,
    tasks: Sequence[int] | None = None,
    dropped: Sequence[int] = (),
    workers: int | None = None,
    engine: str | BaseEngine = "local",
    address: str | None = None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    progress: Callable[[BuildEvent], None] | None = None,
) -> BuildReport:
    """Builds what is missing of a dataset; a finished one is left as it is.

    Args:
        out: dataset folder: new, empty, or a dataset of the same recipe and seed, which is extended.
        seed: root seed of behavior training and rollouts.
        tasks: indices of the full task set instead of the profile's choice.
        dropped: indices of tasks that the dataset is to do without; their parts stay on disk, and a later
            build that names them in `tasks` takes them up again.
        workers: units run at the same time; as many as the engine has cores where None.
        engine: an engine's name, or an engine, which has its own workers and address.
        checkpoint_seconds: least time between two checkpoints of behavior training, which a build that was
            stopped continues from. Writing them takes 5 % of the time at most; 0 is as often as possible.

    Raises:
        BuildError: a seed outside [0, 2**63), `out` is no dataset, or one of other settings or another seed.
        LockedError: another process builds this dataset.
        StoreError: a published part is damaged.
        ReadOnlyError: the folder cannot be written, and something is missing.
        StorageError: too little free space, or the disk refused; what was published stands.
    """
    started = time.monotonic()
    if not 0 <= seed < SEEDS:
        raise BuildError(f"seed {seed} is not in [0, 2**63); choose a smaller --seed")
    runner = make_engine(engine, workers, address)
    plan = plan_build(recipe, seed=seed, tasks=tasks, dropped=dropped)
    _check_folder(out, recipe, seed)
    plan.check_limits()
    if ENVIRONMENTS.provider(recipe.environment.name.partition("/")[0]) != "tcmrl":
        check_environment(plan.environment)  # before hours of training; ours pass the tests
    make_folders(out)
    failed: tuple[str, ...] = ()
    read_only = False
    try:
        with lock_file(out / LOCK, f"dataset {out}"):
            remove_abandoned(out)
            ledger = Ledger(plan, out, taken_up=tasks or ())
            ledger.plan.check_limits()
            _check_space(out, ledger.num_missing * plan.part_bytes, ledger.num_missing)
            present = ledger.num_parts
            if ledger.num_missing:
                driver = Driver(ledger, out.resolve(), checkpoint_seconds=checkpoint_seconds)
                failed = driver.run(runner, StatusFile(out, progress))
            elif not ledger.is_sealed():
                ledger.begin()
    except ReadOnlyError:
        ledger = Ledger(plan, out, taken_up=tasks or ())
        present, read_only = ledger.num_parts, True
        if ledger.num_missing or not ledger.is_sealed():
            raise
    seconds = time.monotonic() - started
    return BuildReport(out, ledger.num_parts - present, present, failed, seconds, ledger.root, read_only)


def _check_folder(out: Path, recipe: Recipe, seed: int) -> None:
    if not out.exists():
        return
    is_dataset = (out / MANIFEST).is_file()  # files of others beside the data are `verify`'s to name
    if not out.is_dir() or (not is_dataset and {entry.name for entry in out.iterdir()} - OWN_FILES):
        raise BuildError(f"--out {out} exists and is no dataset; choose another folder")
    check_work_files(out)
    if (out / ASSEMBLY).exists() and not is_dataset:
        raise BuildError(f"{out} holds the beginning of a derived dataset; use another --out")
    if not is_dataset and (out / MANIFEST_COPY).exists():
        raise BuildError(f"{out} has lost its {MANIFEST}; `tcmrl-data verify {out} --repair` restores it")
    if not is_dataset:
        return
    manifest = read_manifest(out)
    if manifest.derivation is not None or manifest.runs[0].kind != "built":
        raise BuildError(f"{out} holds parts that no build makes; use another --out")
    if manifest.data_version != DATA_VERSION:
        raise BuildError(
            f"{out} has data version {manifest.data_version}, not {DATA_VERSION}; use another --out"
        )
    if manifest.seed != seed:
        raise BuildError(f"{out} was built with seed {manifest.seed}, not {seed}; use another --out")
    old, new = (full_settings(of.unit_settings()) for of in (manifest.recipe, recipe))
    for name, was, wanted in (
        ("environment", manifest.name, recipe.environment.name),
        ("profile", manifest.profile, recipe.profile),
    ):
        if was != wanted and old != new:
            raise BuildError(
                f"{out} was built with {name} {was}, not {wanted}; name that, or use another --out"
            )
    for place, there, here in differences(old, new):
        raise BuildError(
            f"{out} was built with other settings: {place} is {there} there and {here} here; "
            "use another --out"
        )


def _check_space(out: Path, needed: int, num_parts: int) -> None:
    """Refuses a build that the disk has no room for, arrays counted before compression."""
    free = shutil.disk_usage(out).free
    if needed > free:
        raise StorageError(
            f"{out}: {num_parts} parts take up to {size(needed)}, {size(free)} are free; "
            "make room or build fewer --tasks at a time"
        )


WORKER = "tcmrl_data.building.plan"
"""Module that does a unit."""


class Driver:
    """Runs the units that have missing parts; the only writer of the ledger."""

    def __init__(
        self, ledger: Ledger, dataset: Path, *, checkpoint_seconds: float = CHECKPOINT_SECONDS
    ) -> None:
        self._checkpoint_seconds = checkpoint_seconds
        self._ledger, self._plan, self._dataset = ledger, ledger.plan, dataset
        self._steps_done = self._steps_total = 0
        self._deadline = 0.0

    def run(self, engine: BaseEngine, log: StatusFile) -> tuple[str, ...]:
        """Runs the units; returns one line per failure.

        However the units end, the manifest then names every part that was taken in.
        """
        ledger = self._ledger
        groups = [group for group in self._plan.groups if any(ledger.missing(task.index) for task in group)]
        tasks_of = {_unit_id(group): group for group in groups}
        self._steps_total = self._plan.source.training_steps * sum(map(len, groups))
        failures: list[str] = []
        remarks = list(self._remarks())
        if engine.takes_address:
            from tcmrl_data.building.nodes import check_nodes

            remarks = [*check_nodes(engine, self._plan, self._dataset), *remarks]
        self._deadline = VISIBLE_SECONDS if engine.takes_address else 0.0
        ledger.begin()
        try:
            log.write(self._event("start", f"{ledger.num_missing} parts to build"))
            for remark in remarks:
                log.write(self._event("warning", remark))
            results = engine.run(
                [self._unit(group) for group in groups],
                lambda unit, message: self._on_message(unit, message, log),
            )
            with contextlib.closing(results):
                for result in results:
                    result = self._checked(result, tasks_of[result.id])
                    if result.ok:
                        log.write(self._event("unit_done", f"{result.id} done", result.id))
                    else:
                        failures.append(
                            f"{result.id} failed after {result.attempt} attempt(s) on {result.node}: "
                            f"{result.error}"
                        )
                        log.write(self._event("unit_failed", failures[-1], result.id))
        except KeyboardInterrupt:
            for group in groups:
                self._take_in_unreported(group)
            raise
        finally:
            ledger.seal()
            log.write(self._event("end", f"{ledger.num_parts} parts, {len(failures)} units failed"))
        return tuple(sorted(failures))

    def _remarks(self) -> list[str]:
        damaged = [
            f"{file} was damaged before it was recorded; it is made again" for file in self._ledger.damaged
        ]
        here, earlier = self._plan.platform, self._ledger.platforms
        if not earlier or here.digest() in {platform.digest() for platform in earlier}:
            return damaged
        differences = "; ".join(here.differences(earlier[-1]))
        return [
            *damaged,
            f"parts were made on another platform ({differences}); missing parts are made on this one, and "
            "nothing is compared across the two",
        ]

    def _unit(self, tasks: tuple[Task, ...]) -> Unit:
        """The unit of a group; done and dropped tasks stay in it, since their absence may change rounding."""
        plan = self._plan
        spec = UnitSpec(self._dataset, dataclasses.replace(plan, tasks=tasks), self._checkpoint_seconds)
        reserved = plan.recipe.build
        return Unit(
            _unit_id(tasks),
            to_json(spec),
            WORKER,
            cost=plan.source.training_steps * len(tasks),
            cpus=reserved.cpus,
            gpus=reserved.gpus,
            memory=max(reserved.memory, plan.unit_bytes(len(tasks))),
            timeout=reserved.timeout,
        )

    def _checked(self, result: Result, tasks: Sequence[Task]) -> Result:
        missing = self._take_in_unreported(tasks, deadline=self._deadline if result.ok else 0.0)
        if result.ok and missing:
            problem = f"it ended without {len(missing)} of its parts, the first is {part_file(missing[0])}"
            return dataclasses.replace(result, ok=False, error=problem)
        return result

    def _take_in_unreported(self, tasks: Sequence[Task], *, deadline: float = 0.0) -> list[PartKey]:
        """Takes in parts whose messages were lost, with their workers; returns the missing."""
        take_in = self._ledger.take_in_unreported
        return [key for task in tasks for key in take_in(task.index, deadline=deadline)]

    def _on_message(self, unit: str, message: Mapping[str, Any], log: StatusFile) -> None:
        if message["kind"] == "steps":
            self._steps_done += message["count"]
            log.write(self._event("steps", unit, unit))
            return
        if message["kind"] == "warning":
            log.write(self._event("warning", f"{unit}: {message['message']}", unit))
            return
        published = Published.from_message(message)
        if self._ledger.take_in(published, deadline=self._deadline):
            log.write(self._event("part", f"{unit}, step {published.entry.step}", unit))

    def _event(self, kind: EventKind, message: str, unit: str | None = None) -> BuildEvent:
        return BuildEvent(
            kind=kind,
            unit=unit,
            parts_done=self._ledger.num_parts,
            parts_total=self._ledger.num_parts + self._ledger.num_missing,
            steps_done=self._steps_done,
            steps_total=self._steps_total,
            message=message,
        )


def _unit_id(tasks: Sequence[Task]) -> str:
    first, last = tasks[0].index, tasks[-1].index
    return f"task {first}" if len(tasks) == 1 else f"{len(tasks)} tasks from {first} to {last}"
