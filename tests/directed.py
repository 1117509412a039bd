"""Workers that die or wait at a chosen place, so that no test depends on timing.

A unit's spec carries the directions; files in a folder count the events. The program is the worker.
"""

import importlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pytest

from tcmrl_data.engine.base import Unit
from tcmrl_data.foundation import disk
from tests.workers import wait_for

BUILD, EXPERIMENT = "tcmrl_data.building.build", "tcmrl_algo.experiment.run"
"""The modules that make units."""

WORKERS = {BUILD: "tcmrl_data.building.plan", EXPERIMENT: "tcmrl_algo.experiment.job"}
"""Module that does the work of a unit, by the module that makes the unit."""

Report = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class Directions:
    """Where and how often the workers of some units die or wait.

    Attributes:
        folder: holds a file per death, a file per waiting worker, and `hold` until `release`.
        at: `part` after a worker reported a part, `steps` after it reported steps, `publishing` when it has
            written half of a part.
        passes: how often a worker passes that place before it dies or waits.
        deaths: how many workers are killed there, over all units; the workers after them wait.
        unit: id of the only unit that gets directions; None for all units.
        driver: the module that makes the units.
    """

    folder: str
    at: Literal["part", "steps", "publishing"] = "part"
    passes: int = 0
    deaths: int = 0
    unit: str | None = None
    driver: str = BUILD

    def hold(self) -> "Directions":
        """Makes workers wait until `release`."""
        Path(self.folder).mkdir(exist_ok=True)
        (Path(self.folder) / "hold").touch()
        return self

    def release(self) -> None:
        """Lets workers continue."""
        (Path(self.folder) / "hold").unlink()

    def died(self) -> set[int]:
        """Process ids of the workers that were killed."""
        return {int(file.suffix[1:]) for file in Path(self.folder).glob("died.*")}

    def waiting(self) -> set[int]:
        """Process ids of the workers that wait, or waited."""
        return {int(file.suffix[1:]) for file in Path(self.folder).glob("waiting.*")}

    def direct(self, unit: Unit) -> Unit:
        """The unit with these directions, if they apply to it."""
        if self.unit not in (None, unit.id):
            return unit
        Path(self.folder).mkdir(exist_ok=True)
        return replace(unit, worker=__name__, spec={**unit.spec, "directions": asdict(self)})

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Gives these directions to every unit that this process makes."""
        made = importlib.import_module(self.driver)
        patch.setattr(made, "Unit", lambda *values, **named: self.direct(Unit(*values, **named)))

    def wait(self, driver: "subprocess.Popen[str]", workers: int = 1) -> None:
        """Waits until `workers` workers wait, or the process that drives them has ended."""
        wait_for(lambda: len(self.waiting()) >= workers or driver.poll() is not None, "workers that wait")
        assert driver.poll() is None, driver.communicate()

    def obey(self) -> None:
        """Kills this process or waits, as the directions say."""
        folder = Path(self.folder)
        if len(self.died()) < self.deaths:
            (folder / f"died.{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        (folder / f"waiting.{os.getpid()}").touch()
        while (folder / "hold").exists():
            time.sleep(0.005)


def work(spec: dict[str, Any], report: Report) -> str:
    directions = Directions(**spec.pop("directions"))
    left = directions.passes

    class HalfWritten(disk.Disk):
        def write(self, path: Path, data: bytes) -> None:
            super().write(path, data)
            if directions.at == "publishing" and disk.STAGING in path.parts and ".zip." in path.name:
                directions.obey()

    def report_and_obey(message: Mapping[str, Any]) -> None:
        nonlocal left
        report(message)
        if message["kind"] == directions.at:
            if not left:
                directions.obey()
            left = max(0, left - 1)

    disk.disk = HalfWritten()
    digest: str = importlib.import_module(WORKERS[directions.driver]).work(spec, report_and_obey)
    return digest


def run_directed(main: Callable[[], object], directions: Directions) -> None:
    """Runs a command line whose units get directions."""
    directions.install(pytest.MonkeyPatch())
    main()
