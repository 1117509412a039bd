"""Layering that the import linter cannot check: lazy imports, packaging, and type checks at run time."""

import ast
import importlib
import json
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import jaxtyping
import pytest
import torch

import tcmrl_algo
import tcmrl_data
from tcmrl_algo.algorithms.tcmrl import sparsity_loss
from tcmrl_algo.evaluation.protocols.base import PROTOCOLS
from tcmrl_data.envs.base import ENVIRONMENTS
from tests import experiments
from tests.plugin_packages import install

ROOT = Path(__file__).parents[1]
FOLDERS = {
    "tcmrl_algo": "tcmrl_algo",
    "tcmrl_data": "tcmrl_data",
    "cli": "tcmrl_cli",
    "manifests": "tcmrl_manifests",
}
HEAVY = {"torch", "stable_baselines3", "metaworld", "mujoco", "matplotlib", "tensorboard"}
SLOW = HEAVY | {"gymnasium", "numpy", "pydantic"}
"""What completions and helps do without."""

COMPLETIONS = (
    "tcmrl-data show da",
    "tcmrl-data build point",
    "tcmrl train --algo t",
)
HELPS = ("tcmrl-data --help", "tcmrl-data build --help", "tcmrl train --help", "tcmrl evaluate --help")
LOOKS = (
    "tcmrl-data envs",
    "tcmrl-data build point-robot --recipe --profile quick",
    "tcmrl-data list data",
    "tcmrl-data inspect returns data/point-robot",
    "tcmrl-data inspect tasks data/point-robot",
    "tcmrl-data inspect snapshots data/point-robot",
    "tcmrl-data inspect episodes data/point-robot",
    "tcmrl-data inspect quality data/point-robot",
    "tcmrl-data inspect coverage data/point-robot",
    "tcmrl-data inspect rewards data/point-robot",
    "tcmrl-data export data/point-robot --format hdf5 --out out",
    "tcmrl experiment small.toml --out results",
)
PLOT = "tcmrl-data inspect returns data/point-robot --plot returns.png"

PROBE = """
import contextlib, importlib, io, json, os, sys

def command(line, complete=False):
    from tcmrl_cli.frame import run
    program, *words = line.split(" ")
    name = {"tcmrl-data": "data", "tcmrl": "tcmrl"}[program]
    root = getattr(importlib.import_module("tcmrl_cli." + {"data": "data", "tcmrl": "train"}[name]), name)
    if not complete:
        return run(root, words)
    variable = "_" + program.replace("-", "_").upper() + "_COMPLETE"
    os.environ |= {variable: "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(words))}
    try:
        return run(root)
    except SystemExit as ended:
        return ended.code
    finally:
        del os.environ[variable]

def environments():
    from tcmrl_data.envs.base import ENVIRONMENTS
    print(len(ENVIRONMENTS.members()))
    return 0

steps = {
    **{f"import {name}": lambda name=name: importlib.import_module(name) is None for name in sys.argv[1:]},
    **{"complete " + line: lambda line=line: command(line, complete=True) for line in COMPLETIONS},
    **{line: lambda line=line: command(line) for line in (*HELPS, *LOOKS, PLOT)},
    "environments": environments,
}
steps[PLOT] = steps.pop(PLOT)
for name, step in steps.items():
    with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)) as output:
        code = int(step())
    print(json.dumps([name, code, output.buffer.getvalue().decode(), sorted(sys.modules)]))
"""


@dataclass(frozen=True)
class Done:
    """What a step printed, and all modules that the interpreter held after it."""

    output: str
    modules: frozenset[str]


@pytest.fixture(scope="module")
def done(tiny_folder: Path, small_results: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Done]:
    """Imports and commands, done in this order in one fresh interpreter; what loads something comes last."""
    place = tmp_path_factory.mktemp("place")
    (place / "data").mkdir()
    (place / "data" / "point-robot").symlink_to(tiny_folder)
    experiments.write_file(place / "small.toml", experiments.tables(tiny_folder))
    shutil.copytree(small_results, place / "results")
    declares = {"tcmrl.engines": "cloud = users_engine:Cloud"}
    modules = {"users_engine": "raise RuntimeError('imported')"}
    install(place / "site", "users-package", modules=modules, declares=declares)
    named = {"COMPLETIONS": COMPLETIONS, "HELPS": HELPS, "LOOKS": LOOKS, "PLOT": PLOT}
    code = "\n".join(f"{name} = {value!r}" for name, value in named.items()) + PROBE
    result = subprocess.run(
        [sys.executable, "-c", code, "tcmrl_data", "tcmrl_algo"],
        cwd=place,
        env=os.environ | {"PYTHONPATH": str(place / "site")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    steps = [json.loads(line) for line in result.stdout.splitlines()]
    assert [name for name, code, _, _ in steps if code != 0] == [], result.stderr
    return {name: Done(output, frozenset(modules)) for name, _, output, modules in steps}


@pytest.mark.parametrize("line", LOOKS)
def test_looking_at_data_and_finished_work_loads_nothing_heavy(line: str, done: dict[str, Done]) -> None:
    assert done[line].modules & HEAVY == set()


@pytest.mark.parametrize("line", COMPLETIONS)
def test_completing_loads_nothing_slow(line: str, done: dict[str, Done]) -> None:
    assert done[f"complete {line}"].output.strip()
    assert done[f"complete {line}"].modules & SLOW == set()


@pytest.mark.parametrize("line", HELPS)
def test_help_loads_nothing_slow_and_no_plugin(line: str, done: dict[str, Done]) -> None:
    assert done[line].modules & (SLOW | {"users_engine"}) == set()


def test_help_names_plugins_and_shows_examples(done: dict[str, Done]) -> None:
    assert "--engine [cloud|local|ray]" in done["tcmrl-data build --help"].output
    assert "tcmrl train data/point-robot" in done["tcmrl train --help"].output
    assert "|".join([*PROTOCOLS.names(), "all"]) in done["tcmrl evaluate --help"].output


def test_listing_environments_imports_nothing_heavy(done: dict[str, Done]) -> None:
    assert int(done["environments"].output) == len(ENVIRONMENTS.members())
    assert done["environments"].modules & HEAVY == set()


def test_a_plot_loads_matplotlib_and_no_window(done: dict[str, Done]) -> None:
    assert list(done)[-1] == PLOT
    assert done[PLOT].modules & HEAVY == {"matplotlib"}
    assert "matplotlib.pyplot" not in done[PLOT].modules


@pytest.mark.parametrize("package", [tcmrl_data, tcmrl_algo], ids=lambda package: package.__name__)
def test_roots_load_nothing_until_asked_and_keep_what_they_promise(
    package: object, done: dict[str, Done]
) -> None:
    name = package.__name__  # type: ignore[attr-defined]
    assert done[f"import {name}"].modules & SLOW == set()
    root = importlib.import_module(name)
    assert all(getattr(root, name) is not None for name in root.__all__)
    assert set(root.__all__) <= set(dir(root))
    with pytest.raises(AttributeError, match="attribute nothing"):
        _ = root.nothing


@pytest.mark.check
def test_a_worker_loads_torchs_compiler_only_if_it_compiles() -> None:
    code = (
        "import torch\n"
        "from tcmrl_data.engine.local import serve\n"
        "def work(spec, report):\n"
        "    parameter = torch.nn.Parameter(torch.ones(2))\n"
        "    optimizer = torch.optim.Adam([parameter])\n"
        "    parameter.sum().backward()\n"
        "    optimizer.step()\n"
        "    is_left_out = 'torch._dynamo.config' not in sys.modules\n"
        "    doubled = torch.compile(lambda tensor: 2 * tensor, backend='eager')(torch.ones(2))\n"
        "    return f'{is_left_out} {doubled.tolist()}'\n"
        "import sys\n"
        "serve(__name__)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as worker:
        assert worker.stdin and worker.stdout
        worker.stdin.write("{}\n")
        worker.stdin.flush()
        assert json.loads(worker.stdout.read())["digest"] == "True [2.0, 2.0]"


@pytest.mark.parametrize("room", ["losses", "networks"])
def test_equations_and_networks_import_torch_and_shapes_only(room: str) -> None:
    imported = set()
    for file in (ROOT / "tcmrl_algo" / room).glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add((node.module or "").partition(".")[0])
    assert imported - set(sys.stdlib_module_names) <= {"torch", "jaxtyping", "tcmrl_algo"}


def test_every_package_of_the_tree_is_installed() -> None:
    """A folder that is missing in pyproject.toml works in a checkout and is lost in a wheel."""
    expected = {
        ".".join([name, *path.parent.relative_to(ROOT / folder).parts])
        for folder, name in FOLDERS.items()
        for path in (ROOT / folder).rglob("*.py")
    }
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    assert set(settings["packages"]) == expected
    for name in ("tcmrl_data", "tcmrl_algo"):
        assert {"__init__.pyi", "py.typed"} <= set(settings["package-data"][name])


def test_every_dependency_is_pinned_and_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"].values()
    wanted = [project["dependencies"], *extras]
    names = {text.partition(">")[0].lower() for texts in wanted for text in texts}
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.partition("==")[0].lower().replace("_", "-") for line in pins if "==" in line}
    assert names <= pinned
    explained = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert [name for name in sorted(names) if f"| {name} |" not in explained] == []


def test_stated_shapes_are_checked_at_every_call() -> None:
    """pytest's `--jaxtyping-packages` in pyproject.toml does it; without it, shapes are comments."""
    with pytest.raises(jaxtyping.TypeCheckError, match="sparsity_loss"):
        sparsity_loss(torch.zeros(2, 3), torch.ones(3, 2, dtype=torch.bool))
