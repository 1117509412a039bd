"""Runs the units of a build and takes in what they publish."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tcmrl_data.building.events import BuildEvent, EventKind, EventLog
from tcmrl_data.building.ledger import Ledger
from tcmrl_data.building.nodes import check_nodes
from tcmrl_data.building.unit import UnitSpec
from tcmrl_data.engine.base import BaseEngine, Result, Unit
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.locks import VISIBLE_SECONDS
from tcmrl_data.parts.making import Published
from tcmrl_data.store.keys import PartKey, part_file

WORKER = "tcmrl_data.building.worker"
"""Module that does a unit."""


class Driver:
    """Runs the units that have missing parts.

    Args:
        ledger: of the dataset; the driver is its only writer.
        dataset: the dataset's folder, as workers find it.
    """

    def __init__(self, ledger: Ledger, dataset: Path) -> None:
        self._ledger, self._plan, self._dataset = ledger, ledger.plan, dataset
        self._steps_done = self._steps_total = 0
        self._deadline = 0.0

    def run(self, engine: BaseEngine, log: EventLog) -> tuple[str, ...]:
        """Runs the units; returns one line per failure.

        However the units end, the manifest then names every part that was taken in.
        """
        ledger = self._ledger
        groups = [group for group in self._plan.groups if self._missing(group)]
        tasks_of = {_unit_id(group): group for group in groups}
        self._steps_total = self._plan.source.training_steps * sum(map(len, groups))
        failures: list[str] = []
        remarks = [*check_nodes(engine, self._plan, self._dataset), *self._remarks()]
        self._deadline = VISIBLE_SECONDS if engine.takes_address else 0.0
        ledger.begin()
        try:
            unfinished = len(self._plan.wanted) - ledger.num_tasks_done
            log.write(self._event("start", f"{unfinished} of {len(self._plan.wanted)} tasks to build"))
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
                        failures.append(_failure(result))
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
        """What a user should know before the units start."""
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
        spec = UnitSpec(self._dataset, plan.recipe, plan.seed, tasks, plan.dropped)
        reserved = plan.recipe.build
        return Unit(
            _unit_id(tasks),
            spec.to_json(),
            WORKER,
            cost=plan.source.training_steps * len(tasks),
            cpus=reserved.cpus,
            gpus=reserved.gpus,
            memory=max(reserved.memory, plan.unit_bytes(len(tasks))),
            timeout=reserved.timeout,
        )

    def _missing(self, tasks: Sequence[Task]) -> list[PartKey]:
        """The missing parts of a group."""
        return [key for task in tasks for key in self._ledger.missing(task.index)]

    def _checked(self, result: Result, tasks: Sequence[Task]) -> Result:
        """A unit's result, failed where parts are still missing."""
        self._take_in_unreported(tasks, deadline=self._deadline if result.ok else 0.0)
        missing = self._missing(tasks)
        if result.ok and missing:
            problem = f"it ended without {len(missing)} of its parts, the first is {part_file(missing[0])}"
            return dataclasses.replace(result, ok=False, error=problem)
        return result

    def _take_in_unreported(self, tasks: Sequence[Task], *, deadline: float = 0.0) -> None:
        """Takes in parts whose messages were lost, with the worker that published them."""
        for task in tasks:
            self._ledger.take_in_unreported(task.index, deadline=deadline)

    def _on_message(self, unit: str, message: Mapping[str, Any], log: EventLog) -> None:
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
            tasks_done=self._ledger.num_tasks_done,
            tasks_total=len(self._plan.wanted),
            parts_done=self._ledger.num_parts,
            parts_total=self._ledger.num_parts + self._ledger.num_missing,
            steps_done=self._steps_done,
            steps_total=self._steps_total,
            message=message,
        )


def _unit_id(tasks: Sequence[Task]) -> str:
    first, last = tasks[0].index, tasks[-1].index
    return f"task {first}" if len(tasks) == 1 else f"{len(tasks)} tasks from {first} to {last}"


def _failure(result: Result) -> str:
    return f"{result.id} failed after {result.attempt} attempt(s) on {result.node}: {result.error}"
