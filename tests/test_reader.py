"""What `requirements-reader.txt` installs is enough to look at datasets, check them, derive and export."""

import json
import os
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
READER = ROOT / "requirements-reader.txt"

WORKS = (
    "tcmrl-data show data",
    "tcmrl-data list .",
    "tcmrl-data envs",
    "tcmrl-data inspect returns data",
    "tcmrl-data inspect tasks data",
    "tcmrl-data inspect quality data",
    "tcmrl-data inspect coverage data",
    "tcmrl-data inspect rewards data",
    "tcmrl-data verify data",
    "tcmrl-data derive data --episodes 2 --out cut",
    "tcmrl-data export data --format idaq-npy --out npy",
    "tcmrl-data card data",
    "tcmrl-data cache list",
)
NAMES = {
    "tcmrl-data build point-robot --profile quick --out made": "torch",
    "tcmrl-data inspect returns data --plot returns.png": "matplotlib",
    "tcmrl-data export data --format hdf5 --out hdf5": "h5py",
}
"""Commands that need more, and the package that their error names."""

PROBE = """
import contextlib, io, json, sys

class Without:
    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):  # how installed distributions are found
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else self.finder.find_spec(name, path, target)

sys.meta_path[:] = map(Without, sys.meta_path)
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

for line in LINES:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as errors:
        code = run(data, line.split()[1:])
    print(json.dumps([line, code, errors.getvalue()]))
"""


def requirements() -> list[Requirement]:
    lines = READER.read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


def installed_by_reader() -> set[str]:
    """The distributions that the file installs, with all that they need."""
    found: set[str] = set()
    open_ones = [canonicalize_name(one.name) for one in requirements()]
    while open_ones:
        name = open_ones.pop()
        if name in found:
            continue
        found.add(name)
        try:
            needed = [Requirement(text) for text in requires(name) or ()]
        except PackageNotFoundError:
            continue
        open_ones += [
            canonicalize_name(one.name)
            for one in needed
            if not one.marker or one.marker.evaluate({"extra": ""})
        ]
    return found


@pytest.fixture(scope="module")
def done(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Exit code and errors of all commands, in one interpreter that has what a reader has."""
    place = tmp_path_factory.mktemp("reader")
    (place / "data").symlink_to(tiny_folder)
    there = installed_by_reader() | {"tcmrl"}
    hidden = {
        module
        for module, distributions in packages_distributions().items()
        if not {canonicalize_name(name) for name in distributions} & there
    }
    assert {"torch", "mujoco", "scipy", "h5py", "matplotlib", "jaxtyping"} <= hidden
    code = f"HIDDEN = {hidden!r}\nLINES = {[*WORKS, *NAMES]!r}\n{PROBE}"
    environment = {key: value for key, value in os.environ.items() if not key.startswith("COV")}
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=place,
        env=environment | {"TCMRL_CACHE": str(place / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    rows: list[Any] = [json.loads(line) for line in result.stdout.splitlines()]
    return {line: (code, errors) for line, code, errors in rows}


@pytest.mark.parametrize("line", WORKS)
def test_a_reader_does_it(line: str, done: dict[str, tuple[int, str]]) -> None:
    assert done[line][0] == 0, done[line][1]


@pytest.mark.parametrize("line", NAMES)
def test_what_a_reader_cannot_do_names_the_package(line: str, done: dict[str, tuple[int, str]]) -> None:
    code, errors = done[line]
    last = errors.strip().splitlines()[-1]
    assert code == 2
    assert re.search(rf"needs the package {NAMES[line]}\b.*pip install tcmrl", last), errors


def test_the_bounds_are_those_of_the_project() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {str(one) for one in requirements()} <= {
        str(Requirement(text)) for text in project["dependencies"]
    }
