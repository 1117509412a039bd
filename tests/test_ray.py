"""What only a cluster has: machines that are lost or too small, and a connection that may fail."""

import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import tcmrl_data
from tcmrl_data import BuildEvent, Recipe, load_recipe
from tcmrl_data.engine.base import ATTEMPTS, Unit
from tcmrl_data.engine.ray import Engine
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.store.manifest import part_folder, read_manifest
from tests.conftest import TASKS, TINY
from tests.workers import ancestors, command_line, marked_pids, wait_for, worker_pids

loopback = pytest.mark.loopback


def ids(folder: Path, *tasks: int) -> dict[tuple[int, int], str]:
    parts = read_manifest(folder).parts
    return {(part.task, part.step): part.id for part in parts if part.task in (tasks or TASKS)}


@pytest.fixture
def second_machine(ray_cluster: Any) -> Iterator[Any]:
    """One more machine with four cores."""
    node = ray_cluster.add_node(num_cpus=4)
    yield node
    if node in ray_cluster.worker_nodes:
        ray_cluster.remove_node(node)


@loopback
def test_a_cluster_that_loses_a_machine_ends_with_the_same_data(
    ray_cluster: Any, second_machine: Any, mark: str, tiny_folder: Path, tmp_path: Path
) -> None:
    """Three cores a unit: one unit runs on each machine at a time."""
    recipe = load_recipe("point-robot", profile="quick", overrides=[*TINY, "build.cpus=3"])
    (raylet,) = second_machine.all_processes["raylet"]
    lost: list[int] = []

    def lose(event: BuildEvent) -> None:
        """Takes the second machine down, with all its processes, while a unit runs there."""
        there = [pid for pid in worker_pids(mark) if raylet.process.pid in ancestors(pid)]
        if event.kind == "part" and there and not lost:
            lost.extend(there)
            ray_cluster.remove_node(second_machine, allow_graceful=False)

    report = tcmrl_data.build_dataset(
        recipe, tmp_path / "data", tasks=[0, 3, 40], engine="ray", address=ray_cluster.address, progress=lose
    )
    assert len(lost) == 1
    assert (report.failed, report.built) == ((), 9)
    assert ids(tmp_path / "data") == ids(tiny_folder, 0, 3, 40)


@loopback
def test_a_supervisor_that_is_killed_is_replaced_by_ray(
    ray_cluster: Any, mark: str, tiny_recipe: Recipe, tiny_folder: Path, tmp_path: Path
) -> None:
    """Its worker ends with it; Ray makes the same attempt again, more often than the engine tries a crash."""
    out, killed = tmp_path / "data", []

    def watch() -> None:
        while len(killed) < ATTEMPTS and not (out / part_folder(0, 150)).exists():
            for pid in set(worker_pids(mark)) - set(killed):
                killed.append(pid)
                os.kill(ancestors(pid)[0], signal.SIGKILL)
                wait_for(lambda: not set(killed) & set(worker_pids(mark)), "the worker's end", seconds=10)
            time.sleep(0.01)

    thread = threading.Thread(target=watch)
    thread.start()
    report = tcmrl_data.build_dataset(tiny_recipe, out, tasks=[0], engine="ray", address=ray_cluster.address)
    thread.join()
    assert len(killed) == ATTEMPTS
    assert (report.failed, report.built) == ((), 3)
    assert ids(out) == ids(tiny_folder, 0)


@loopback
@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("cpus=64", "64 cpus, 0 gpus, 419.5 MB"),
        ("gpus=0.5", "1 cpus, 0.5 gpus, 419.5 MB"),
        ("memory=900000000000000", "1 cpus, 0 gpus, 900.0 TB"),
    ],
)
def test_what_the_cluster_can_never_place_is_refused_at_once(
    ray_cluster: Any, tmp_path: Path, asked: str, told: str
) -> None:
    recipe = load_recipe("point-robot", profile="quick", overrides=[*TINY, f"build.{asked}"])
    with pytest.raises(
        BuildError, match=f"task 3 asks for {re.escape(told)}, more than any machine"
    ) as error:
        tcmrl_data.build_dataset(
            recipe, tmp_path / "data", tasks=[3], engine="ray", address=ray_cluster.address
        )
    assert "4 cpus, 0 gpus" in str(error.value)
    assert list((tmp_path / "data").rglob("part.json")) == []


@loopback
def test_without_an_address_a_cluster_is_started_for_the_build_and_ended_with_it(
    mark: str, tiny_folder: Path, tmp_path: Path
) -> None:
    before = set(marked_pids(mark))
    settings = [argument for override in TINY for argument in ("--set", override)]
    command = ["build", "point-robot", "--profile", "quick", *settings, "--tasks", "3", "--engine", "ray"]
    with command_line(*command, "--workers", "1", "--out", str(tmp_path / "data"), "--json") as driver:
        _, errors = driver.communicate(timeout=120)
    assert driver.returncode == 0, errors
    assert ids(tmp_path / "data") == ids(tiny_folder, 3)
    wait_for(lambda: set(marked_pids(mark)) <= before, "the end of the cluster", seconds=20)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere"])
def test_an_address_where_nobody_answers_is_refused_at_once(address: str) -> None:
    pytest.importorskip("ray")
    with pytest.raises(BuildError, match=f"no connection to a Ray cluster at {address}: .*ray start --head"):
        next(Engine(address=address).run([Unit("task 3", {}, "nothing")], lambda unit, message: None))


def test_without_the_package_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(BuildError, match=re.escape("pip install 'tcmrl[ray]'")):
        next(Engine().run([Unit("task 3", {}, "nothing")], lambda unit, message: None))
