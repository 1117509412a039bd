"""Clusters: machines that are lost or too small, and connections that fail."""

import contextlib
import dataclasses
import os
import re
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

import tcmrl_data
from tcmrl_data import BuildEvent, Recipe, load_recipe
from tcmrl_data.building import nodes
from tcmrl_data.building.nodes import WORKER as NODE_WORKER
from tcmrl_data.building.nodes import check_nodes
from tcmrl_data.building.plan import plan_build
from tcmrl_data.engine.base import ATTEMPTS, Unit
from tcmrl_data.engine.ray import RayEngine
from tcmrl_data.foundation.errors import BuildError
from tests.conftest import TASKS, TINY
from tests.datasets import part_ids
from tests.directed import Directions
from tests.disks import small_disk
from tests.workers import (
    PATIENCE,
    ancestors,
    command_line,
    marked_pids,
    other_version,
    wait_for,
    worker_pids,
)

loopback = pytest.mark.loopback


def ids(folder: Path, *tasks: int) -> dict[tuple[int, int], str]:
    return {key: part for key, part in part_ids(folder).items() if key[0] in (tasks or TASKS)}


@pytest.fixture
def second_machine(ray_cluster: Any) -> Iterator[Any]:
    """A second machine with four cores."""
    node = ray_cluster.add_node(num_cpus=4)
    yield node
    if node in ray_cluster.worker_nodes:
        ray_cluster.remove_node(node)


@loopback
def test_a_cluster_that_loses_a_machine_ends_with_the_same_data(
    ray_cluster: Any,
    second_machine: Any,
    mark: str,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With three cores per unit, one unit runs on every machine and waits after its first part."""
    directions = Directions(str(tmp_path / "directions")).hold()
    directions.install(monkeypatch)
    recipe = load_recipe("point-robot", profile="quick", overrides=[*TINY, "build.cpus=3"])
    (raylet,) = second_machine.all_processes["raylet"]
    lost: list[int] = []

    def lose(event: BuildEvent) -> None:
        """Removes the second machine, with all its processes, while a unit runs there."""
        there = [pid for pid in worker_pids(mark) if raylet.process.pid in ancestors(pid)]
        if event.kind == "part" and there and not lost:
            lost.extend(there)
            ray_cluster.remove_node(second_machine, allow_graceful=False)
            directions.release()

    report = tcmrl_data.build_dataset(
        recipe, tmp_path / "data", tasks=[0, 3, 40], engine="ray", address=ray_cluster.address, progress=lose
    )
    assert len(lost) == 1
    assert (report.failed, report.built) == ((), 9)
    assert ids(tmp_path / "data") == ids(tiny_folder, 0, 3, 40)


@loopback
def test_a_supervisor_that_is_killed_is_replaced_by_ray(
    ray_cluster: Any,
    mark: str,
    tiny_recipe: Recipe,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The worker ends with its supervisor; Ray repeats the attempt more often than the engine does."""
    out, directions = tmp_path / "data", Directions(str(tmp_path / "directions")).hold()
    directions.install(monkeypatch)

    def kill_supervisors() -> None:
        killed: set[int] = set()
        for _ in range(ATTEMPTS):
            wait_for(lambda: directions.waiting() - killed, "a worker that waits")
            (worker,) = directions.waiting() - killed
            killed.add(worker)
            os.kill(ancestors(worker)[0], signal.SIGKILL)
            wait_for(lambda: not worker_pids(mark), "the worker's end")
        directions.release()

    with ThreadPoolExecutor(1) as pool:
        killing = pool.submit(kill_supervisors)
        report = tcmrl_data.build_dataset(
            tiny_recipe, out, tasks=[0], engine="ray", address=ray_cluster.address
        )
        killing.result()
    assert len(directions.waiting()) > ATTEMPTS
    assert (report.failed, report.built) == ((), 3)
    assert ids(out) == ids(tiny_folder, 0)


@contextlib.contextmanager
def machine_started_by(ray_cluster: Any, *prefix: str) -> Iterator[None]:
    """A further machine with four cores, all whose processes a command starts."""
    before = len(live_machines())
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", f"--address={ray_cluster.address}"]
    command += ["--num-cpus=4", "--object-store-memory=80000000", "--block"]
    with subprocess.Popen(
        [*prefix, *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as machine:
        wait_for(lambda: len(live_machines()) > before or machine.poll() is not None, "the machine")
        try:
            yield
        finally:
            machine.terminate()


def live_machines() -> list[str]:
    """Ids of the cluster's machines."""
    import ray

    return [node["NodeID"] for node in ray.nodes() if node["Alive"]]


@loopback
def test_a_unit_runs_once_on_every_machine_that_could_run_it(
    ray_cluster: Any, second_machine: Any, tmp_path: Path
) -> None:
    small = ray_cluster.add_node(num_cpus=1)
    spec = {"token": str(tmp_path), "deadline": 0.0, "tcmrl": "other"}
    unit = Unit("check", spec, NODE_WORKER, cpus=2, timeout=PATIENCE)
    engine = RayEngine(address=ray_cluster.address)
    reports = engine.run_on_every_node(unit)
    expected = [{"kind": "node", "sees_folder": True, "tcmrl": version("tcmrl")}]
    assert [(list(report.messages), report.error) for report in reports] == [(expected, None)] * 2
    failed = engine.run_on_every_node(dataclasses.replace(unit, worker="tcmrl_data.nothing"))
    ray_cluster.remove_node(small)
    assert all("No module named 'tcmrl_data.nothing'" in str(report.error) for report in failed)


@loopback
def test_machines_without_the_folder_or_with_other_versions_are_refused_before_any_unit_starts(
    ray_cluster: Any, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nodes, "FOLDER_SECONDS", 0.1)
    shared = tmp_path / "shared"
    shared.mkdir()
    elsewhere = ["unshare", "--mount", "sh", "-c", f'{small_disk(shared, 1_000)} && exec "$@"', "sh"]
    other = ray_cluster.add_node(num_cpus=4, env_vars=other_version(tmp_path, "numpy"))
    plan, engine = plan_build(tiny_recipe, tasks=[3]), RayEngine(address=ray_cluster.address)
    with machine_started_by(ray_cluster, *elsewhere), pytest.raises(BuildError) as error:
        check_nodes(engine, plan, shared / "data")
    ray_cluster.remove_node(other)
    told = str(error.value).split("; ")
    assert any(re.fullmatch(rf"node \S+ \(\S+\) does not see {shared}/data", line) for line in told)
    assert any(re.fullmatch(r"node \S+ \(\S+\) has other versions \(numpy 0.0.7 .*\)", line) for line in told)
    assert len(told) == 4


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
    with pytest.raises(BuildError, match=f"task 3 needs {re.escape(told)}, more than any machine") as error:
        tcmrl_data.build_dataset(
            recipe, tmp_path / "data", tasks=[3], engine="ray", address=ray_cluster.address
        )
    assert "4 cpus, 0 gpus" in str(error.value)
    assert list((tmp_path / "data").rglob("part.json")) == []


@loopback
def test_without_an_address_a_cluster_is_started_for_the_build_and_ended_with_it(
    tiny_folder: Path, tmp_path: Path
) -> None:
    own = uuid.uuid4().hex
    settings = [argument for override in TINY for argument in ("--set", override)]
    command = ["build", "point-robot", "--profile", "quick", *settings, "--tasks", "3", "--engine", "ray"]
    command += ["--workers", "1", "--out", str(tmp_path / "data"), "--json"]
    with command_line(*command, mark=own) as driver:
        _, errors = driver.communicate(timeout=PATIENCE)
    assert driver.returncode == 0, errors
    assert ids(tmp_path / "data") == ids(tiny_folder, 3)
    wait_for(lambda: not marked_pids(own), "the end of the cluster")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere"])
def test_an_address_where_nobody_answers_is_refused_at_once(address: str) -> None:
    pytest.importorskip("ray")
    with pytest.raises(BuildError, match=f"no connection to a Ray cluster at {address}: .*ray start --head"):
        next(RayEngine(address=address).run([Unit("task 3", {}, "nothing")], lambda unit, message: None))


def test_without_the_package_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(BuildError, match=re.escape("pip install 'tcmrl[ray]'")):
        next(RayEngine().run([Unit("task 3", {}, "nothing")], lambda unit, message: None))
