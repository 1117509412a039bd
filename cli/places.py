"""What a shell completes: datasets, runs, environments, experiments and the keys of recipes.

A completion reads names of files and small TOML and JSON files only; it imports no library that computes.
"""

import contextlib
import importlib.resources
import json
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from tcmrl_data.foundation.plugins import declared_names

if TYPE_CHECKING:
    from tcmrl_data import Address

MANIFEST_FILE, RUN_FILE = "manifest.json", "run.json"
MAX_FOLDERS = 10_000
"""Folders that a completion looks into."""

NO_ENVIRONMENT = "foreign"
"""The declared environment that has no recipe."""


class MarkedFolder(click.Path):
    """A path, completed by the folders that hold a file of a name.

    Args:
        mark: name of the file.
        below: folders to look into where nothing is typed yet.
    """

    def __init__(self, mark: str, *below: str) -> None:
        super().__init__(path_type=Path)
        self._mark, self._below = mark, below

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        places = [incomplete.rpartition("/")[0] or "/"] if "/" in incomplete else self._below
        found = sorted({folder for place in places for folder in _marked(place, self._mark)})
        items = [CompletionItem(folder) for folder in found if folder.startswith(incomplete)]
        return items or super().shell_complete(ctx, param, incomplete)


class DatasetPath(MarkedFolder):
    """The folder of a dataset, a view's file, or an address, which is text."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if isinstance(value, str) and "://" in value else super().convert(value, param, ctx)


DATASET_PATH = DatasetPath(MANIFEST_FILE, "data")
RUN_PATH = MarkedFolder(RUN_FILE, "runs", "results")


def beside(place: "Path | Address", ending: str) -> Path:
    """The path of something made of a dataset: beside it, or in the current folder if it is at an address."""
    if not isinstance(place, Path):
        return Path(f"{place.name}{ending}")
    place = place if place.name not in ("", "..") else place.resolve()
    return place.with_name(f"{place.stem if place.is_file() else place.name}{ending}")


def _marked(place: str, mark: str) -> Iterator[str]:
    """The folders below a place that hold the file, without what lies in them."""
    for count, (folder, inner, files) in enumerate(os.walk(place)):
        if mark in files:
            yield folder
        hidden = [name for name in inner if name.startswith(".")]
        inner[:] = [] if mark in files or count >= MAX_FOLDERS else sorted({*inner} - {*hidden})


def complete_environments(
    ctx: click.Context, param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Environments with a recipe, or files; the members of a family once its name and a slash are typed."""
    recipes = _recipes()
    family, slash, _ = incomplete.partition("/")
    if slash and f"{family}/*" in recipes:
        names: Iterable[str] = _members(family)
    else:
        others = {*declared_names("tcmrl.environments")} - {name.partition("/")[0] for name in recipes}
        names = [name.removesuffix("*") for name in recipes] + sorted(others - {NO_ENVIRONMENT})
    return _starting(names, incomplete) or [CompletionItem(incomplete, type="file")]


def complete_experiments(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Experiments of this package, or files."""
    names = [file.removesuffix(".toml") for file in _shipped("experiments")]
    return _starting(names, incomplete) or [CompletionItem(incomplete, type="file")]


def complete_recipe_keys(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Keys of `--set`: those of the recipe that is typed, with the equals sign."""
    name = _first_argument(ctx, "name_or_file")
    tables = _toml(Path(name)) if name.endswith(".toml") else _recipe_of(name)
    keys = [key for key in _keys(tables) if key.partition(".")[0] not in ("about", "profiles", "variants")]
    return _starting((f"{key}=" for key in keys if "." in key and key != "environment.name"), incomplete)


def complete_training_keys(
    ctx: click.Context, param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Keys of `--set`: those of the training tables that the typed dataset has."""
    file = Path(_first_argument(ctx, "dataset"))
    tables: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        file = file if file.name == MANIFEST_FILE else file / MANIFEST_FILE
        manifest = json.loads(file.read_text(encoding="utf-8"))
        for profile in manifest["runs"][0]["recipe"]["training"].values():
            tables |= profile
    return _starting((f"{key}=" for key in _keys(tables) if "." in key), incomplete)


def _first_argument(ctx: click.Context, name: str) -> str:
    """An argument that is typed; a plain word for click where an option behind it has no value yet."""
    return str(ctx.params.get(name) or next(iter(ctx.args), ""))


def _starting(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in sorted(set(names)) if name.startswith(incomplete)]


def _keys(tables: Mapping[str, Any], table: str = "") -> Iterator[str]:
    """The dotted names of all values; `leaves` would do, but its module loads pydantic, which is slow."""
    for name, value in tables.items():
        if isinstance(value, Mapping):
            yield from _keys(value, f"{table}{name}.")
        else:
            yield f"{table}{name}"


def _shipped(folder: str = "") -> Iterator[str]:
    """The TOML files of the package, or of a folder in it."""
    place = importlib.resources.files("tcmrl_manifests") / folder
    yield from (file.name for file in place.iterdir() if file.name.endswith(".toml"))


def _recipes() -> dict[str, dict[str, Any]]:
    """The recipes of the package by environment; a family's is called `family/*`."""
    place = importlib.resources.files("tcmrl_manifests")
    read = [tomllib.loads((place / file).read_text(encoding="utf-8")) for file in _shipped()]
    return {tables["environment"]["name"]: tables for tables in read if "environment" in tables}


def _recipe_of(name: str) -> dict[str, Any]:
    recipes = _recipes()
    return recipes.get(name) or recipes.get(f"{name.partition('/')[0]}/*") or {}


def _members(family: str) -> list[str]:
    """The environments of a family, which has to be imported for it."""
    from tcmrl_data.envs.base import ENVIRONMENTS
    from tcmrl_data.foundation.plugins import Registry

    return Registry.get(ENVIRONMENTS, family).members()


def _toml(file: Path) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError):
        return tomllib.loads(file.read_text(encoding="utf-8"))
    return {}
