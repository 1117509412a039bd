"""What `tcmrl-data recipe` shows: the values of a recipe, and where they come from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES
from tcmrl_data.recipe.comments import KeyPath, leaf_paths, read_comments
from tcmrl_data.recipe.document import RecipeDocument, open_recipe, read_override
from tcmrl_data.recipe.profile import Profile
from tcmrl_data.recipe.recipe import Recipe, load_recipe

NOT_SHOWN = {("environment", "name"), ("about", "references")}
"""Keys that `--set` does not take: a name that has no effect, and a list of tables."""


@dataclass(frozen=True)
class RecipeValue:
    """One value of a recipe.

    Attributes:
        key: the name by which `--set` changes it.
        value: JSON; None where it is not set.
        source: what the recipe says of its origin; empty where it says nothing.
    """

    key: str
    value: Any
    source: str


@dataclass(frozen=True)
class RecipeValues:
    """All values of a recipe that `--set` can change, in the order of its file, then the defaults."""

    environment: str
    profile: Profile
    values: tuple[RecipeValue, ...]


def recipe_values(
    name_or_file: str | Path, *, profile: Profile = "paper", overrides: Sequence[str] = ()
) -> RecipeValues:
    """The values of a recipe with their sources; arguments and errors as for `load_recipe`."""
    document = open_recipe(name_or_file)
    recipe = load_recipe(name_or_file, profile=profile, overrides=overrides)
    sources = _sources(document, profile, overrides)
    tables = document.tables(profile, overrides)
    written = {path: _value_at(tables, path) for path in leaf_paths(tables)}
    own = recipe.behavior.source
    extended = ("behavior", BEHAVIOR_SOURCES.get(own).extends or own)
    known = {*written, *(("behavior", own, *path[2:]) for path in written if path[:2] == extended)}
    values = written | {path: value for path, value in _resolved(recipe).items() if path not in known}
    return RecipeValues(
        document.environment,
        profile,
        tuple(
            RecipeValue(".".join(path), value, sources.get(path, "default"))
            for path, value in values.items()
            if path not in NOT_SHOWN
        ),
    )


def _sources(document: RecipeDocument, profile: Profile, overrides: Sequence[str]) -> dict[KeyPath, str]:
    """The source of every value, that of the uppermost layer that has the value."""
    comments = read_comments(document.text)
    sources: dict[KeyPath, str] = {}
    for layer in document.layers(profile):
        for path, comment in comments.items():
            if path[: len(layer)] == layer:
                said = [f"{layer[0].removesuffix('s')} {layer[1]}"] if layer else []
                sources[path[len(layer) :]] = ": ".join([*said, *filter(None, [comment])])
    for text in overrides:
        keys, value = read_override(text)
        paths = leaf_paths({"": value})
        sources |= {(*keys, *path[1:]): "--set" for path in paths}
    return sources


def _resolved(recipe: Recipe) -> dict[KeyPath, Any]:
    """The values of the validated tables, defaults included; all settings of the source below its name."""
    behavior = recipe.behavior.model_dump(mode="json")
    behavior[recipe.behavior.source] = behavior.pop("settings")
    tables = recipe.unit_settings() | {"behavior": behavior, "build": recipe.build.model_dump(mode="json")}
    return {path: _value_at(tables, path) for path in leaf_paths(tables)}


def _value_at(tables: Mapping[str, Any], path: KeyPath) -> Any:
    value: Any = tables
    for key in path:
        value = value[key]
    return value
