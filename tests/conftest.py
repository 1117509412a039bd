"""Shared fixtures: one real, tiny dataset, built once per session with the real libraries."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import tcmrl_data
from tcmrl_data import Dataset, Recipe

TASKS = [0, 3, 40, 60, 99]
TINY = (
    "behavior.sac.steps=150",
    "behavior.sac.warmup=50",
    "behavior.sac.snapshots=[0,100,150]",
    "behavior.sac.hidden=[16,16]",
    "behavior.sac.batch_size=16",
    "rollouts.episodes=6",
    "rollouts.lanes=3",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--sweep", type=int, default=40, help="try every n-th case of the exhaustive sweeps")


@pytest.fixture
def sweep(request: pytest.FixtureRequest) -> int:
    """Stride through sweeps that take minutes in full; `--sweep 1` tries every case."""
    stride: int = request.config.getoption("--sweep")
    return stride


@pytest.fixture(scope="session")
def tiny_recipe() -> Recipe:
    return tcmrl_data.load_recipe("point-robot", profile="quick", overrides=TINY)


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory, tiny_recipe: Recipe) -> Path:
    """Folder of the tiny dataset: five tasks (one of them test), three snapshots, six episodes each."""
    folder = tmp_path_factory.mktemp("datasets") / "tiny"
    report = tcmrl_data.build_dataset(tiny_recipe, folder, tasks=TASKS, workers=2)
    assert (report.failed, report.built) == ((), len(TASKS) * 3)
    return folder


@pytest.fixture(scope="session")
def tiny(tiny_folder: Path) -> Dataset:
    return tcmrl_data.open_dataset(tiny_folder)


@pytest.fixture
def tiny_copy(tiny_folder: Path, tmp_path: Path) -> Callable[[], Path]:
    """Makes copies of the tiny dataset to damage."""

    def copy() -> Path:
        target = tmp_path / f"copy-{len(list(tmp_path.iterdir()))}"
        shutil.copytree(tiny_folder, target)
        return target

    return copy
