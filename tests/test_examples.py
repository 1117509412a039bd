"""A user's package, installed as a wheel together with tcmrl's wheel into a separate environment."""

import json
import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest

from tests.plugin_packages import install
from tests.workers import PATIENCE, ROOT

pytestmark = pytest.mark.check  # two wheels are built and installed first

TINY = (
    "behavior.sac.steps=60",
    "behavior.sac.warmup=20",
    "behavior.sac.snapshots=[0,60]",
    "behavior.sac.hidden=[8]",
    "behavior.sac.batch_size=8",
    "environment.horizon=20",
    "rollouts.episodes=4",
    "rollouts.lanes=4",
    "build.train_tasks=2",
    "build.test_tasks=1",
)


class Installation:
    """An environment whose packages are wheels of the tree; libraries come from the running Python's."""

    def __init__(self, folder: Path) -> None:
        venv.create(folder, with_pip=False)
        self.scripts = folder / "bin"
        (self.site,) = (folder / "lib").glob("python3*/site-packages")
        libraries = [path for path in sys.path if Path(path).name == "site-packages"]
        (self.site / "libraries.pth").write_text("\n".join(libraries))
        self._folder = folder

    def install(self, source: Path) -> None:
        """Builds a wheel of a source tree, without the network, and installs it."""
        wheels = self._folder / "wheels" / source.name
        copy = self._folder / "source" / source.name
        shutil.copytree(source, copy, ignore=_no_source)
        _run(sys.executable, "-m", "pip", "wheel", *OFFLINE, "--no-build-isolation", "-w", wheels, copy)
        (wheel,) = wheels.glob("*.whl")
        python = self.scripts / "python"
        _run(sys.executable, "-m", "pip", "--python", python, "install", *OFFLINE, wheel)

    def call(self, program: str, *arguments: object) -> str:
        """Standard output of a console script that must succeed."""
        return _run(self.scripts / program, *arguments)


SHORT = (
    "run.log_every=5",
    "run.episodes=3",
    "run.final_episodes=1",
    "run.random_episodes=1",
    "actor_critic.hidden=[8]",
)
OFFLINE = ("--quiet", "--no-deps", "--no-index")


def _run(*command: object) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in command],
        cwd="/",
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout


def _no_source(folder: str, names: list[str]) -> set[str]:
    """Files that builds and commands leave in a tree, from .gitignore; some only at the top level."""
    made = {"data", "runs", "build", "dist"} if (Path(folder) / "pyproject.toml").is_file() else set()
    return {name for name in names if name in made | {"__pycache__"} or name.startswith(".")}


def _set(settings: tuple[str, ...]) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    """tcmrl, the example, and a package whose one plug-in raises when it is imported."""
    made = Installation(tmp_path_factory.mktemp("installation"))
    made.install(ROOT)
    made.install(ROOT / "examples" / "pendulum")
    groups = ("environments", "algorithms", "formats")
    declares = {f"tcmrl.{group}": "defect = tcmrl_defect:Plugin" for group in groups}
    source = {"tcmrl_defect": "raise OSError('no such licence')"}
    install(made.site, "tcmrl-defect", modules=source, declares=declares)
    return made


@pytest.fixture(scope="module")
def pendulum(installation: Installation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset of the example's environment, by its own recipe."""
    out = tmp_path_factory.mktemp("pendulum") / "data"
    options = ["--profile", "quick", "--behavior", "sac", "--workers", 1, "--quiet"]
    installation.call("tcmrl-data", "build", "pendulum", *options, *_set(TINY), "--out", out)
    return out


def test_the_environment_of_a_users_package_is_built_and_verified(
    installation: Installation, pendulum: Path
) -> None:
    tasks = json.loads(installation.call("tcmrl-data", "inspect", "tasks", pendulum, "--json"))["tasks"]
    assert [sorted(task["parameters"]) for task in tasks] == [["gravity", "length", "mass"]] * 3
    document = json.loads(installation.call("tcmrl-data", "verify", pendulum, "--replay", 1, "--json"))
    assert document["findings"] == []


def test_the_method_of_a_users_package_is_trained_and_evaluated(
    installation: Installation, pendulum: Path, tmp_path: Path
) -> None:
    options = ["--algo", "reward_regression", "--stop-at", 10, "--quiet", *_set(SHORT)]
    installation.call("tcmrl", "train", pendulum, *options, "--out", tmp_path / "run")
    document = json.loads(installation.call("tcmrl", "evaluate", tmp_path / "run", "--json"))
    assert document["algorithm"] == "reward_regression"
    assert np.isfinite(document["mean_final"])


def test_the_method_of_a_users_package_passes_the_contract_tests(installation: Installation) -> None:
    """The command of `docs/how-to/extend.md`, where the package is installed for this one process."""
    command = "python -m pytest tests/test_algorithms.py -k reward_regression"
    assert command in (ROOT / "docs/how-to/extend.md").read_text(encoding="utf-8")
    done = subprocess.run(
        [sys.executable, *command.split()[1:], "-p", "no:cacheprovider"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(installation.site)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "trains_resumes_and_evaluates_by_the_command_line" not in done.stdout  # neither failed nor skipped
    assert int(re.findall(r"(\d+) passed", done.stdout)[0]) >= 14, done.stdout


def test_the_format_of_a_users_package_holds_every_episode(
    installation: Installation, pendulum: Path, tmp_path: Path
) -> None:
    out = tmp_path / "exported"
    installation.call("tcmrl-data", "export", pendulum, "--format", "npz", "--out", out)
    assert len(list(out.iterdir())) == 3
    with np.load(out / "task_00000.npz", allow_pickle=False) as arrays:
        assert arrays["observations"].shape == arrays["next_observations"].shape == (160, 3)
        assert (arrays["actions"].shape, int(arrays["truncated"].sum())) == ((160, 1), 8)
        assert np.unique(arrays["snapshot"]).tolist() == [0, 60]
        same_episode = arrays["episode"][1:] == arrays["episode"][:-1]
        follows = (arrays["next_observations"][:-1] == arrays["observations"][1:]).all(axis=1)
        assert (follows == same_episode).all()
        assert json.loads(str(arrays["task"]))["index"] == 0


def test_the_operation_of_a_users_package_makes_a_dataset(
    installation: Installation, pendulum: Path, tmp_path: Path
) -> None:
    """Its parts are made again by it, once they lie beside those that they were made from."""
    out, both = tmp_path / "half", tmp_path / "both"
    code = (
        "import tcmrl_data; "
        f"made = tcmrl_data.apply_operation({str(pendulum)!r}, {str(out)!r}, 'every-nth', {{'n': 2}}); "
        "print(made.manifest.totals.episodes, made.manifest.runs[0].kind, made.manifest.runs[0].name)"
    )
    assert installation.call("python", "-c", code).split() == ["12", "derived", "every-nth"]
    installation.call("tcmrl-data", "merge", pendulum, out, "--out", both, "--quiet")
    installation.call("tcmrl-data", "verify", both, "--deep", "--quiet")


def test_a_plug_in_that_cannot_be_imported_is_listed_with_its_error(installation: Installation) -> None:
    listing = installation.call("tcmrl-data", "envs")
    assert "pendulum" in listing and "point-robot" in listing
    assert "defect" in listing and "no such licence" in listing
