"""One contract for every engine; those that talk over a network run in tests/test_namespace.py."""

import json
import os
import random
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import pytest
import torch

import tcmrl_data
from tcmrl_data import Dataset, Recipe, load_recipe
from tcmrl_data.building.build import WORKER
from tcmrl_data.building.plan import BuildPlan, UnitSpec
from tcmrl_data.engine import local
from tcmrl_data.engine.base import ENGINES, BaseEngine, Message, Result, Unit, longest_first
from tcmrl_data.engine.local import InProcessEngine, LocalEngine
from tcmrl_data.foundation.disk import STAGING
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.records import digest, to_json
from tcmrl_data.recipe.recipe import choose_tasks
from tcmrl_data.store.manifest import read_manifest
from tcmrl_data.store.tables import PartKey, part_file
from tests.conftest import TASKS, TINY
from tests.datasets import part_ids
from tests.directed import Directions
from tests.workers import PATIENCE, ROOT, command_line, wait_for, worker_pids

CASES = [
    pytest.param(name, marks=[pytest.mark.loopback] if engine.takes_address else [])
    for name, engine in ENGINES.working().items()
]

LONG = (*TINY, "behavior.sac.steps=100000", "behavior.sac.snapshots=[0,100,100000]")
"""Units that take minutes: they end in time only if they are ended."""


@pytest.fixture(scope="module")
def long_recipe() -> Recipe:
    return load_recipe("point-robot", profile="quick", overrides=LONG)


@dataclass(frozen=True)
class EngineCase:
    """An engine to test, the address of its cluster if any, and the mark of its workers."""

    name: str
    address: str | None
    mark: str

    def create(self, workers: int) -> BaseEngine:
        return ENGINES.get(self.name)(workers, address=self.address)

    def command(self, out: Path, *, tasks: str, workers: int, overrides: tuple[str, ...] = TINY) -> list[str]:
        """Arguments of `tcmrl-data` that build a part of the tiny dataset with this engine."""
        settings = [argument for override in overrides for argument in ("--set", override)]
        address = [] if self.address is None else ["--ray-address", self.address]
        command = ["build", "point-robot", "--profile", "quick", *settings, "--engine", self.name, *address]
        return [*command, "--tasks", tasks, "--workers", str(workers), "--out", str(out)]


@pytest.fixture(scope="module", params=CASES)
def engine(request: pytest.FixtureRequest, mark: str) -> EngineCase:
    networked = ENGINES.get(request.param).takes_address
    address = request.getfixturevalue("ray_cluster").address if networked else None
    return EngineCase(request.param, address, mark)


@pytest.fixture
def directions(tmp_path: Path) -> Directions:
    return Directions(str(tmp_path / "directions"))


def make_units(recipe: Recipe, out: Path, tasks: list[int]) -> list[Unit]:
    """Units as a build makes them, and the folders that they need."""
    (out / STAGING).mkdir(parents=True)
    units = []
    for task in choose_tasks(recipe, tasks):
        spec = UnitSpec(out.resolve(), BuildPlan(recipe, 0, (task,)))
        units.append(Unit(f"task {task.index}", to_json(spec), WORKER))
    return units


def run(engine: EngineCase, units: list[Unit], *, workers: int = 2) -> dict[str, Result]:
    return {result.id: result for result in engine.create(workers).run(units, lambda unit, message: None)}


def reference(tiny: Dataset, task: int) -> str:
    """What a unit must return."""
    return digest([entry.id for entry in tiny.parts.entries_of(task)])


def ids(folder: Path, *tasks: int) -> dict[tuple[int, int], str]:
    return {key: part_id for key, part_id in part_ids(folder).items() if key[0] in (tasks or TASKS)}


def has_part(out: Path, task: int, step: int) -> bool:
    return (out / part_file(PartKey(task, step))).is_file()


def staged(out: Path) -> list[str]:
    return sorted(path.name for path in (out / STAGING).iterdir())


@pytest.mark.check
@pytest.mark.parametrize("workers", [1, 4])
def test_digests_do_not_depend_on_workers_or_order(
    engine: EngineCase, workers: int, tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    tasks = TASKS[:2] if workers == 1 else TASKS[:3]
    units = make_units(tiny_recipe, tmp_path / "data", tasks)
    random.Random(workers).shuffle(units)
    results = run(engine, [replace(unit, cost=random.random()) for unit in units], workers=workers)
    assert {name: result.digest for name, result in results.items()} == {
        f"task {task}": reference(tiny, task) for task in tasks
    }
    assert all(result.ok and result.attempt == 1 and result.error is None for result in results.values())


@pytest.mark.check
def test_a_killed_worker_is_replaced_and_the_data_are_the_same(
    engine: EngineCase,
    tiny_folder: Path,
    tiny_recipe: Recipe,
    directions: Directions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "data"
    killed = replace(directions, deaths=1)
    killed.install(monkeypatch)
    report = tcmrl_data.build_dataset(
        tiny_recipe, out, tasks=[0], workers=1, engine=engine.name, address=engine.address
    )
    assert len(killed.died()) == 1
    assert (report.failed, report.built) == ((), 3)
    assert ids(out) == ids(tiny_folder, 0)
    assert read_manifest(out).complete


@pytest.mark.check
def test_an_error_that_a_unit_reports_is_final_and_the_others_are_done(
    engine: EngineCase, tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    """Another attempt cannot repair a file in the place of a part."""
    units = make_units(tiny_recipe, tmp_path / "data", [3, 40])
    blocked = tmp_path / "data" / part_file(PartKey(3, 100))
    blocked.parent.mkdir(parents=True)
    blocked.write_text("in the way")
    results = run(engine, units)
    assert (results["task 3"].ok, results["task 3"].attempt) == (False, 1)
    assert str(blocked) in str(results["task 3"].error)
    assert results["task 40"].digest == reference(tiny, 40)


def test_a_unit_out_of_time_is_ended_and_tried_once_more(
    engine: EngineCase, long_recipe: Recipe, tmp_path: Path
) -> None:
    (unit,) = make_units(long_recipe, tmp_path / "data", [3])
    (result,) = run(engine, [replace(unit, timeout=0.2)]).values()
    assert result == Result(
        "task 3", False, None, "ran longer than its 0.2 s (build.timeout)", 2, result.node
    )
    assert worker_pids(engine.mark) == []


@pytest.mark.check
def test_a_crash_is_told_in_the_words_of_the_worker(
    engine: EngineCase, tiny: Dataset, tmp_path: Path
) -> None:
    """A network of 400 TB fails in a library, not in a check of the unit."""
    huge = load_recipe(
        "point-robot", profile="quick", overrides=[*TINY, "behavior.sac.hidden=[10000000,10000000]"]
    )
    (result,) = run(engine, make_units(huge, tmp_path / "data", [3])).values()
    assert (result.ok, result.digest, result.attempt) == (False, None, 2)
    assert "worker ended with code 1: RuntimeError" in str(result.error)
    assert "memory" in str(result.error)


@pytest.mark.check
def test_a_unit_run_twice_at_once_makes_its_data_once(
    engine: EngineCase, tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    (unit,) = make_units(tiny_recipe, tmp_path / "data", [40])
    results = run(engine, [unit, replace(unit, id="again")])
    assert [result.digest for result in results.values()] == [reference(tiny, 40)] * 2
    assert len(list((tmp_path / "data").rglob("*.zip"))) == 3
    assert staged(tmp_path / "data") == []


@pytest.mark.check
def test_a_poison_unit_is_named_the_others_are_done_and_the_exit_code_is_1(
    engine: EngineCase, tiny_folder: Path, directions: Directions, tmp_path: Path
) -> None:
    """Every worker of task 3 is killed after its next part; the parts published before stay."""
    out = tmp_path / "data"
    poison = replace(directions, unit="task 3", deaths=2)
    with command_line(*engine.command(out, tasks="3,40", workers=2), directions=poison) as driver:
        _, errors = driver.communicate(timeout=PATIENCE)
    assert (len(poison.died()), driver.returncode) == (2, 1), errors
    assert "Error: task 3 failed after 2 attempt(s) on " in errors
    assert "killed by signal 9" in errors
    assert ids(out) == {key: part_id for key, part_id in ids(tiny_folder, 3, 40).items() if key != (3, 150)}
    assert not read_manifest(out).complete


@pytest.mark.check
@pytest.mark.parametrize(
    ("engine", "number"),
    [
        pytest.param("local", signal.SIGINT, id="local-SIGINT"),
        *(pytest.param(*case.values, signal.SIGTERM, marks=case.marks) for case in CASES),
    ],
    indirect=["engine"],
)
def test_an_interrupted_build_ends_its_workers_and_says_how_to_go_on(
    engine: EngineCase, number: signal.Signals, tmp_path: Path
) -> None:
    out = tmp_path / "data"
    command = engine.command(out, tasks="0,3", workers=2, overrides=LONG)
    with command_line(*command, "--quiet") as driver:
        wait_for(lambda: has_part(out, 0, 0) or has_part(out, 3, 0) or driver.poll() is not None, "a part")
        assert all(os.getpgid(pid) != driver.pid for pid in worker_pids(engine.mark))
        os.killpg(driver.pid, number)  # to the whole process group, as a terminal does
        _, errors = driver.communicate(timeout=PATIENCE)
    told = [line for line in errors.splitlines() if line.startswith("Error:")]
    again = shlex.join(["tcmrl-data", *command, "--quiet"])
    assert told == [f"Error: interrupted; finished work is kept in {out}; to continue, run `{again}` again"]
    assert "Traceback" not in errors
    assert driver.returncode == 1
    assert worker_pids(engine.mark) == []
    assert staged(out) == []
    published = {(int(file.parent.name), int(file.stem)) for file in (out / "parts").rglob("*.zip")}
    assert {step for _, step in published} in ({0}, {0, 100})
    assert part_ids(out).keys() <= published  # the last of them may not have been told to the driver


@pytest.mark.check
def test_a_killed_driver_leaves_no_worker_and_the_same_command_goes_on(
    engine: EngineCase, tiny_folder: Path, directions: Directions, tmp_path: Path
) -> None:
    out = tmp_path / "data"
    command = engine.command(out, tasks="0", workers=1)
    with command_line(*command, directions=directions.hold()) as driver:
        directions.wait(driver)
        assert directions.waiting() == set(worker_pids(engine.mark))
        driver.kill()
        driver.wait()
        wait_for(lambda: not worker_pids(engine.mark), "the end of the workers")
    assert has_part(out, 0, 0) and not has_part(out, 0, 100)
    with command_line(*command) as driver:
        _, errors = driver.communicate(timeout=PATIENCE)
    assert (driver.returncode, ids(out)) == (0, ids(tiny_folder, 0)), errors


def test_a_worker_ends_with_its_driver(long_recipe: Recipe, tmp_path: Path) -> None:
    """It ends when its input closes, long before its unit is done."""
    (unit,) = make_units(long_recipe, tmp_path / "data", [40])
    command = [sys.executable, "-m", "tcmrl_data.engine.local", WORKER]
    worker = subprocess.run(
        command, cwd=ROOT, text=True, input=json.dumps(unit.spec) + "\n", capture_output=True, check=False
    )
    assert worker.returncode == 1
    assert "result" not in worker.stdout
    assert not has_part(tmp_path / "data", 40, 100_000)


@pytest.mark.check
def test_a_worker_told_to_end_in_the_middle_of_publishing_leaves_nothing_half_done(
    tiny: Dataset, tiny_recipe: Recipe, directions: Directions, tmp_path: Path
) -> None:
    (unit,) = make_units(tiny_recipe, tmp_path / "data", [40])
    halfway = replace(directions, at="publishing").hold()
    directed = halfway.direct(unit)
    command = [sys.executable, "-m", "tcmrl_data.engine.local", directed.worker]
    with subprocess.Popen(
        command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as worker:
        assert worker.stdin is not None
        worker.stdin.write(json.dumps(directed.spec) + "\n")
        worker.stdin.flush()
        halfway.wait(worker)
        assert len(staged(tmp_path / "data")) == 1  # a part that is not yet synced
        worker.terminate()
        assert worker.wait(PATIENCE) == 128 + signal.SIGTERM
    assert staged(tmp_path / "data") == []
    assert list((tmp_path / "data").rglob("*.zip")) == []
    assert run(EngineCase("local", None, ""), [unit])["task 40"].digest == reference(tiny, 40)


def test_the_engine_inside_the_process_makes_the_same_parts_and_restores_the_threads(
    tiny_folder: Path, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # not a worker's number, on which bits may depend
    try:
        report = tcmrl_data.build_dataset(tiny_recipe, tmp_path, tasks=[0, 3], engine=InProcessEngine())
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert (report.failed, report.built, ids(tmp_path)) == ((), 6, ids(tiny_folder, 0, 3))


def test_the_engine_inside_the_process_returns_errors_and_raises_crashes(
    tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    units = make_units(tiny_recipe, tmp_path / "data", [3, 40])
    blocked = tmp_path / "data" / part_file(PartKey(3, 100))
    blocked.parent.mkdir(parents=True)
    blocked.write_text("in the way")
    messages: list[tuple[str, str]] = []
    units = [replace(unit, cost=float(unit.id == "task 40")) for unit in units]
    results = list(InProcessEngine().run(units, lambda unit, told: messages.append((unit, told["kind"]))))
    assert [result.id for result in results] == [unit.id for unit in longest_first(units)]
    done, failed = results
    assert (done.digest, failed.ok) == (reference(tiny, 40), False)
    assert str(blocked) in str(failed.error)
    assert messages.count(("task 40", "part")) == 3
    spec = units[0].spec
    crashing = replace(units[0], spec={**spec, "plan": {**spec["plan"], "tasks": ["no task"]}})
    with pytest.raises(ValueError, match="Input should be an object"):
        list(InProcessEngine().run([crashing], lambda unit, message: None))


@pytest.mark.parametrize(
    ("program", "error"),
    [("/bin/false", "worker ended with code 1: no message"), ("/nowhere", "no worker could be started: ")],
)
def test_a_worker_that_ends_before_it_has_read_its_spec_is_a_crash(
    program: str, error: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The spec is written after the worker has ended, so the pipe is already closed."""
    start = local._start_worker

    def start_and_outlive(unit: Unit, errors: IO[str]) -> "subprocess.Popen[str]":
        worker = start(unit, errors)
        worker.wait()
        return worker

    monkeypatch.setattr(local, "_start_worker", start_and_outlive)
    monkeypatch.setattr(sys, "executable", program)
    (result,) = run(EngineCase("local", None, ""), [Unit("task 3", {}, WORKER)]).values()
    assert (result.ok, result.attempt) == (False, 2)
    assert error in str(result.error)


@pytest.mark.check
def test_parts_whose_messages_are_lost_are_taken_in_all_the_same(
    tiny_recipe: Recipe, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker can be killed between publishing a part and reporting it."""
    run_and_tell = LocalEngine.run

    def run_silently(self: BaseEngine, units: list[Unit], on_message: Message) -> Iterator[Result]:
        yield from run_and_tell(self, units, lambda unit, message: None)

    monkeypatch.setattr(LocalEngine, "run", run_silently)
    report = tcmrl_data.build_dataset(tiny_recipe, tmp_path / "data", tasks=[3], workers=1)
    assert (report.built, ids(tmp_path / "data")) == (3, ids(tiny_folder, 3))


def test_an_address_is_refused_by_an_engine_that_has_none(tmp_path: Path, tiny_recipe: Recipe) -> None:
    with pytest.raises(BuildError, match="takes no address, got 'here:1'"):
        tcmrl_data.build_dataset(tiny_recipe, tmp_path / "data", engine="local", address="here:1")
