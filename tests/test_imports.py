"""Layering that the import linter cannot check: lazy imports, packaging, and type checks at run time."""

import ast
import importlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import jaxtyping
import pytest
import torch

import tcmrl_algo
import tcmrl_data
from tcmrl_algo.losses import context as losses

ROOT = Path(__file__).parents[1]
FOLDERS = {
    "tcmrl_algo": "tcmrl_algo",
    "tcmrl_data": "tcmrl_data",
    "cli": "tcmrl_cli",
    "manifests": "tcmrl_manifests",
}
HEAVY = {"torch", "stable_baselines3", "metaworld", "mujoco", "matplotlib", "tensorboard"}


def loaded_after(code: str, *arguments: str) -> set[str]:
    """The heavy libraries that a fresh interpreter holds after running code."""
    script = f"import json, sys\n{code}\nprint(json.dumps(sorted(sys.modules)), file=sys.stderr)"
    result = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True
    )
    return HEAVY & set(json.loads(result.stderr.splitlines()[-1]))


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["build", "--help"],
        ["envs"],
        ["recipe", "point-robot", "--profile", "quick"],
        ["list", "PARENT"],
        ["inspect", "returns", "DATASET"],
        ["inspect", "returns", "DATASET", "--recompute"],
        ["inspect", "tasks", "DATASET"],
        ["inspect", "snapshots", "DATASET"],
        ["inspect", "episodes", "DATASET"],
        ["inspect", "quality", "DATASET"],
        ["inspect", "coverage", "DATASET"],
        ["inspect", "rewards", "DATASET"],
        ["export", "DATASET", "--format", "hdf5", "--out", "OUT"],
    ],
    ids=" ".join,
)
def test_looking_at_data_loads_nothing_heavy(arguments: list[str], tiny_folder: Path, tmp_path: Path) -> None:
    places = {"PARENT": str(tiny_folder.parent), "DATASET": str(tiny_folder), "OUT": str(tmp_path / "out")}
    code = (
        "from tcmrl_cli.data import data\n"
        "from tcmrl_cli.frame import run\n"
        "assert run(data, sys.argv[1:]) == 0\n"
    )
    assert loaded_after(code, *(places.get(argument, argument) for argument in arguments)) == set()


def test_a_plot_loads_matplotlib_and_no_window(tiny_folder: Path, tmp_path: Path) -> None:
    code = (
        "from tcmrl_cli.data import data\n"
        "from tcmrl_cli.frame import run\n"
        "assert run(data, sys.argv[1:]) == 0\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    arguments = ["inspect", "returns", str(tiny_folder), "--plot", str(tmp_path / "returns.png")]
    assert loaded_after(code, *arguments) == {"matplotlib"}


@pytest.mark.parametrize("package", [tcmrl_data, tcmrl_algo], ids=lambda package: package.__name__)
def test_roots_load_nothing_until_asked_and_keep_what_they_promise(package: object) -> None:
    name = package.__name__  # type: ignore[attr-defined]
    assert loaded_after(f"import {name}") == set()
    root = importlib.import_module(name)
    assert all(getattr(root, name) is not None for name in root.__all__)
    assert set(root.__all__) <= set(dir(root))
    with pytest.raises(AttributeError, match="attribute nothing"):
        _ = root.nothing


@pytest.mark.sweep
def test_a_worker_loads_torchs_compiler_only_if_it_compiles() -> None:
    code = (
        "import torch\n"
        "from tcmrl_data.engine.worker import serve\n"
        "def work(spec, report):\n"
        "    parameter = torch.nn.Parameter(torch.ones(2))\n"
        "    optimizer = torch.optim.Adam([parameter])\n"
        "    parameter.sum().backward()\n"
        "    optimizer.step()\n"
        "    is_left_out = 'torch._dynamo.config' not in sys.modules\n"
        "    doubled = torch.compile(lambda tensor: 2 * tensor, backend='eager')(torch.ones(2))\n"
        "    return f'{is_left_out} {doubled.tolist()}'\n"
        "import sys\n"
        "serve(work)\n"
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
        losses.sparsity_loss(torch.zeros(2, 3), torch.ones(3, 2, dtype=torch.bool))
