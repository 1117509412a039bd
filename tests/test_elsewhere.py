"""Other libraries read what `docs/how-to/exchange.md` says that they read, each in an environment of its own.

Every test runs a Python block of that page in a fresh environment with the packages that the page names, and
looks at what it made. Environments for libraries of PyTorch take it from this one.
"""

import json
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

import tcmrl_data
from tcmrl_data import Dataset
from tcmrl_data.describe.card import write_card
from tcmrl_data.interchange.minari import dataset_id
from tcmrl_data.store.tables import PartKey

pytestmark = pytest.mark.sweep

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/how-to/exchange.md").read_text(encoding="utf-8")
STEPS, STEPS_OF_TASK = {"train": 4 * 360, "test": 360}, 360
TASK_TEST, EPISODES = 3, 18

OWN = ("datasets", "duckdb", "polars", "pandas", "xarray", "tensorstore")
"""Packages that need nothing of this environment."""

BORROWED = {
    "minari": ("minari==0.5.4",),
    "robomimic": (
        *("robomimic==0.3.0", "torchvision==0.28.0", "protobuf", "imageio-ffmpeg", "psutil", "tensorboardX"),
        "termcolor",
    ),
    "d3rlpy": (
        *("d3rlpy==2.8.1", "gymnasium==1.0.0", "gym", "gym-notices", "structlog", "colorama"),
        *("dataclasses-json", "marshmallow", "typing-inspect", "mypy-extensions"),
    ),
    "torchrl": ("torchrl==0.14.0",),
}
"""What is installed without its dependencies, by the library that is tried."""

Run = Callable[[str], Any]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this tree."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(lambda name: (ROOT / name).is_file(), listed.splitlines()):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    call = f"from setuptools import build_meta; build_meta.build_wheel({str(out)!r})"
    subprocess.run([sys.executable, "-c", call], cwd=source, check=True, capture_output=True)
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def place(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the dataset and the exports that the page names."""
    folder = tmp_path_factory.mktemp("place")
    shutil.copytree(tiny.folder, folder / "data/demo")
    for name, out in {
        "hdf5": "data/demo-hdf5",
        **{name: f"exports/{name}" for name in ("minari", "parquet", "robomimic")},
    }.items():
        tcmrl_data.export_dataset(tiny, name, folder / out)
    (folder / "shared").mkdir()
    write_card(tiny, folder / "shared/README.md", viewer=True)
    return folder


@pytest.fixture(scope="module")
def own(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs code where only the libraries are that need nothing of this environment."""
    return environment(tmp_path_factory.mktemp("own"), place, [*OWN, "pyarrow", "zarr"])


@pytest.fixture
def borrowing(place: Path, wheel: Path, tmp_path: Path) -> Callable[[str], Run]:
    """Makes a place where a library runs beside this project's wheel, on the packages of this environment."""

    def made(library: str) -> Run:
        return environment(tmp_path / "venv", place, [*BORROWED[library], str(wheel)], borrowed=True)

    return made


def environment(folder: Path, place: Path, packages: Sequence[str], *, borrowed: bool = False) -> Run:
    """A fresh environment; the returned function gives what code prints last as JSON."""
    venv.create(folder, with_pip=True)
    python = folder / "bin/python"
    (site,) = (folder / "lib").glob("python*/site-packages")
    if borrowed:  # a line in a .pth file does not run the .pth files that lie there
        (site / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
    options = ["--no-deps"] if borrowed else []
    command = [python, "-m", "pip", "install", "--quiet", *options, *packages]
    installed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert installed.returncode == 0, installed.stderr[-2_000:]

    def run(code: str) -> Any:
        (folder / "reads.py").write_text(code)
        variables = {
            "PATH": "/usr/bin:/bin",
            "HOME": str(folder),
            "HF_HUB_OFFLINE": "1",
            "MUJOCO_GL": "disabled",
        }
        command = [python, folder / "reads.py"]
        done = subprocess.run(
            command, cwd=place, env=variables, capture_output=True, text=True, check=False, timeout=600
        )
        assert done.returncode == 0, done.stderr[-2_000:]
        return json.loads(done.stdout.splitlines()[-1])

    return run


def block(library: str) -> str:
    """The block of the page that imports a library."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    (found,) = [text for text in blocks if re.search(rf"^(import|from) .*\b{library}\b", text, re.MULTILINE)]
    return f"import json\n{found}"


def test_load_dataset_gives_the_two_splits(own: Run) -> None:
    code = block("datasets") + (
        'tables = {name: datasets.load_dataset("shared", name) for name in ("episodes", "parts", "tasks")}\n'
        "counts = lambda found: {split: len(rows) for split, rows in found.items()}\n"
        'tests = sorted(set(rows["test"]["task"]))\n'
        "print(json.dumps([counts(rows), tests, {name: counts(table) for name, table in tables.items()}]))"
    )
    counts, tests, tables = own(code)
    assert counts == STEPS
    assert tests == [TASK_TEST]
    assert tables == {
        "episodes": {"train": 4 * EPISODES, "test": EPISODES},
        "parts": {"train": 4 * 3, "test": 3},
        "tasks": {"train": 4, "test": 1},
    }


def test_duckdb_groups_by_split(own: Run, tiny: Dataset) -> None:
    rows = own(block("duckdb") + "print(json.dumps(returns.fetchall()))")
    assert {(split, task) for split, task, *_ in rows} == {(task.split, task.index) for task in tiny.tasks}
    found = {(task, step): mean for _, task, step, mean in rows}
    entry = tiny.entry(PartKey(TASK_TEST, 150, "main"))
    assert len(rows) == 15 and found[TASK_TEST, 150] == pytest.approx(entry.mean)


def test_polars_and_pandas_read_a_split(own: Run) -> None:
    for library in ("polars", "pandas"):
        height, splits = own(block(library) + 'print(json.dumps([len(rows), list(rows["split"].unique())]))')
        assert (height, splits) == (STEPS["train"], ["train"])


def test_xarray_and_tensorstore_open_a_part(own: Run, tiny: Dataset) -> None:
    first = tiny.trajectories(tiny.tasks[0].index, 0)[0]
    sizes, reward = own(block("xarray") + "print(json.dumps([dict(part.sizes), float(part.rewards[0])]))")
    assert (sizes["step"], reward) == (120, pytest.approx(float(first.rewards[0])))
    assert own(block("tensorstore") + "print(json.dumps(rewards[:20].tolist()))") == pytest.approx(
        first.rewards.tolist()
    )


def test_minari_loads_and_recovers_from_the_wheel(borrowing: Callable[[str], Run], tiny: Dataset) -> None:
    name = dataset_id(tiny, TASK_TEST)
    code = block("minari") + (
        f"opened = minari.load_dataset({name!r})\n"
        "import tcmrl_data, warnings; warnings.simplefilter('ignore')\n"
        "environment = opened.recover_environment()\n"
        "seed = next(iter(opened.storage.get_episode_metadata([0])))['seed']\n"
        "first, _ = environment.reset(seed=seed)\n"
        "after, reward, *_ = environment.step(opened[0].actions[0])\n"
        "counts = [opened.total_steps, opened.total_episodes, len(episodes)]\n"
        "requirements = opened.storage.metadata['requirements']\n"
        "print(json.dumps([*counts, after.tolist(), float(reward), requirements, tcmrl_data.__file__]))"
    )
    steps, count, sampled, after, reward, requirements, file = borrowing("minari")(code)
    episode = tiny.trajectories(TASK_TEST, 0)[0]
    assert (steps, count, sampled) == (STEPS_OF_TASK, EPISODES, 5)
    assert after == pytest.approx(episode.observations[1].tolist(), abs=1e-6)
    assert reward == pytest.approx(float(episode.rewards[0]), abs=1e-6)
    assert [one.partition("==")[0] for one in requirements] == ["tcmrl", "gymnasium"]
    assert str(ROOT) not in file


def test_robomimic_reads_sequences_of_a_split(borrowing: Callable[[str], Run]) -> None:
    code = block("robomimic") + 'print(json.dumps([len(steps), list(steps[0]["obs"]["flat"].shape)]))'
    assert borrowing("robomimic")(code) == [STEPS_OF_TASK, [1, 2]]


def test_d3rlpy_trains(borrowing: Callable[[str], Run]) -> None:
    text = block("d3rlpy").replace("n_steps=10_000", "n_steps=10, n_steps_per_epoch=10, save_interval=100")
    code = text + "print(json.dumps([len(dataset.episodes), dataset.transition_count]))"
    episodes, steps = borrowing("d3rlpy")(code)
    assert episodes == EPISODES
    assert steps == STEPS_OF_TASK - EPISODES  # d3rlpy drops the last step before a time limit


def test_torchrl_samples_a_split(borrowing: Callable[[str], Run], tiny: Dataset) -> None:
    code = block("torchrl") + (
        'tasks, shape = sorted(set(steps["task"].tolist())), list(batch["next", "reward"].shape)\n'
        "print(json.dumps([len(buffer), tasks, shape]))"
    )
    trained = [task.index for task in tiny.train_tasks]
    assert borrowing("torchrl")(code) == [STEPS["train"], trained, [256, 1]]
