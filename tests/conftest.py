"""Shared fixtures: one real, tiny dataset, built once per session with the real libraries."""

import fcntl
import gc
import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

import tcmrl_data
from tcmrl_data import Dataset, Recipe
from tcmrl_data.engine.local import InProcessEngine, LocalEngine
from tests import commands
from tests.namespace import has_only_loopback
from tests.workers import MARK, ROOT

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # more threads than one wait without spinning
sys.path.append(str(Path(__file__).parent / "doubles"))  # a distribution: methods as plug-ins
sys.path.append(str(ROOT))  # for `benchmarks`, which makes datasets of many parts

TASKS = [0, 3, 40, 60, 99]
TINY = (
    "behavior.source=sac",
    "behavior.sac.steps=150",
    "behavior.sac.warmup=50",
    "behavior.sac.snapshots=[0,100,150]",
    "behavior.sac.hidden=[16,16]",
    "behavior.sac.batch_size=16",
    "behavior.sac.train_frequency=5",
    "rollouts.episodes=6",
    "rollouts.lanes=3",
)

SIMULATED = (
    "environment.horizon=20",
    "behavior.source=sac",
    "behavior.sac.steps=60",
    "behavior.sac.warmup=30",
    "behavior.sac.snapshots=[0,60]",
    "behavior.sac.hidden=[16]",
    "behavior.sac.batch_size=16",
    "rollouts.episodes=4",
    "rollouts.lanes=2",
)
"""A robot's behavior in a second."""

QUICK_TO_NOTICE = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_health_check_period_ms": "500",
    "RAY_health_check_timeout_ms": "60000",
    "RAY_health_check_failure_threshold": "4",
}
"""Settings of Ray under which the loss of a machine, where nobody answers, is noticed in seconds.

A machine that is only slow to answer is not taken for lost.
"""

settings.register_profile("unhurried", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("unhurried")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--sweep", type=int, default=40, help="try every n-th case of the exhaustive sweeps")
    parser.addoption("--tiny", type=Path, help="the tiny dataset, if it was made before")


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves out exhaustive cases, and tests that need a separate network: test_namespace.py runs these.

    With `--sweep 1`, exhaustive cases and tests that try every n-th case count as sweeps.
    """
    left_out = {"exhaustive"}
    if config.getoption("--sweep") == 1:
        left_out.clear()
        for item in items:
            if item.get_closest_marker("exhaustive") or "sweep" in getattr(item, "fixturenames", ()):
                item.add_marker("sweep")
    if not has_only_loopback():
        left_out.add("loopback")
    elsewhere = [item for item in items if any(map(item.get_closest_marker, left_out))]
    items[:] = [item for item in items if item not in elsewhere]
    config.hook.pytest_deselected(items=elsewhere)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keeps the garbage collector from the million objects of libraries and tests, which all stay."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def sweep(request: pytest.FixtureRequest) -> int:
    """Step between the tested cases of long sweeps; `--sweep 1` tests every case."""
    stride: int = request.config.getoption("--sweep")
    return stride


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache of this session, so that no test finds what an earlier version left in the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TCMRL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def call(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> commands.Call:
    """Runs `tcmrl-data` in this process, or the program that the module names as `PROGRAM`."""
    from tcmrl_cli.data import data

    return commands.in_process(getattr(request.module, "PROGRAM", data), capsys)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What starts worker processes on this machine does their work here, without the seconds of a start.

    `tests/test_engines.py` holds that both engines give the same.
    """
    monkeypatch.setattr(LocalEngine, "run", InProcessEngine.run)


@pytest.fixture(scope="module")
def module_in_process() -> Iterator[None]:
    """`in_process` for a whole module, its fixtures included."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LocalEngine, "run", InProcessEngine.run)
        yield


@pytest.fixture(scope="session")
def mark() -> Iterator[str]:
    """A mark in the environment of every process that this session starts."""
    value = uuid.uuid4().hex
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(MARK, value)
        patch.setenv("PYTHONPATH", str(ROOT))  # workers that Ray starts find `tests.directed` too
        yield value


@pytest.fixture(scope="session")
def ray_cluster(mark: str) -> Iterator[Any]:
    """A Ray cluster of one machine with four cores; machines may be added, and removed again."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in QUICK_TO_NOTICE.items():
            patch.setenv(name, value)
        import ray
        from ray.cluster_utils import Cluster

        cluster = Cluster(
            initialize_head=True, connect=True, head_node_args={"num_cpus": 4, "include_dashboard": False}
        )
        yield cluster
        ray.shutdown()
        cluster.shutdown()


def made_once(name: str, make: Callable[[Path], object], factory: pytest.TempPathFactory) -> Path:
    """A folder that one process of the session makes for all of them; nobody may change it.

    Args:
        name: of the folder, in that of the session.
        make: fills the folder, which is new.
        factory: pytest-xdist gives that of each process a folder in the session's.
    """
    session = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        session = session.parent
    folder = session / name
    folder.parent.mkdir(exist_ok=True)
    made = session / f"{folder.name}.made"
    with (session / f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a process that failed
            make(folder)
            made.touch()
    return folder


@pytest.fixture(scope="session")
def tiny_recipe() -> Recipe:
    return tcmrl_data.load_recipe("point-robot", profile="quick", overrides=TINY)


@pytest.fixture(scope="session")
def tiny_folder(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, tiny_recipe: Recipe
) -> Path:
    """Folder of the tiny dataset: five tasks (one of them test), three snapshots, six episodes each."""
    made_before: Path | None = request.config.getoption("--tiny")
    if made_before is not None:
        return made_before

    def make(folder: Path) -> None:
        report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, engine=InProcessEngine())
        assert (report.failed, report.built) == ((), len(TASKS) * 3)

    return made_once("datasets/tiny", make, tmp_path_factory)


@pytest.fixture(scope="session")
def small_results(tmp_path_factory: pytest.TempPathFactory, tiny_folder: Path) -> Path:
    """The results folder of the small experiment of `tests/experiments.py`, with all its runs."""
    from tests.experiments import run_small

    return made_once("small-results", lambda folder: run_small(tiny_folder, folder), tmp_path_factory)


@pytest.fixture(scope="session")
def tiny(tiny_folder: Path) -> Dataset:
    return tcmrl_data.open_dataset(tiny_folder)


@pytest.fixture(scope="session")
def exported_hdf5(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole tiny dataset in HDF5, a file for each task."""
    out = tmp_path_factory.mktemp("exports") / "hdf5"
    tcmrl_data.export_dataset(tiny, "hdf5", out)
    return out


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder in memory if the system has one, because thousands of syncs on a disk are slow."""
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if os.access(shared, os.W_OK) else None) as folder:
        yield Path(folder)


@pytest.fixture
def tiny_copy(tiny_folder: Path, tmp_path: Path) -> Callable[[], Path]:
    """Makes copies of the tiny dataset to damage."""

    def copy() -> Path:
        target = tmp_path / f"copy-{len(list(tmp_path.iterdir()))}"
        shutil.copytree(tiny_folder, target)
        return target

    return copy
