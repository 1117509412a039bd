"""The values of recipes with the comments that name their sources, and the list of environments."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES
from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.plugins import one_line_error
from tcmrl_data.foundation.records import leaves
from tcmrl_data.recipe import Profile
from tcmrl_data.recipe.document import RecipeDocument, open_recipe, read_override
from tcmrl_data.recipe.recipe import Recipe, load_recipe

if TYPE_CHECKING:
    from tomlkit.items import Item, Key

KeyPath = tuple[str, ...]

NOT_SHOWN = {("environment", "name"), ("about", "references")}
"""Keys that `--set` does not accept: a name without effect, and a list of tables."""


@dataclass(frozen=True)
class RecipeValue:
    """One value of a recipe.

    Attributes:
        value: a JSON value; None if it is not set.
        source: the recipe's comment on the value's origin; empty if there is none.
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
    written = dict(leaves({name: table for name, table in tables.items() if table}))
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
    """The source of every value in the last layer that sets it."""
    comments = read_comments(document.text)
    sources: dict[KeyPath, str] = {}
    for layer in document.layers(profile):
        for path, comment in comments.items():
            if path[: len(layer)] == layer:
                said = [f"{layer[0].removesuffix('s')} {layer[1]}"] if layer else []
                sources[path[len(layer) :]] = ": ".join([*said, *filter(None, [comment])])
    for text in overrides:
        keys, value = read_override(text)
        sources |= {(*keys, *path[1:]): "--set" for path, _ in leaves({"": value})}
    return sources


def _resolved(recipe: Recipe) -> dict[KeyPath, Any]:
    """The values of the validated tables with defaults; the source's settings stand under its name."""
    behavior = recipe.behavior.model_dump(mode="json")
    behavior[recipe.behavior.source] = behavior.pop("settings")
    tables = recipe.unit_settings() | {"behavior": behavior, "build": recipe.build.model_dump(mode="json")}
    return dict(leaves(tables))


def read_comments(text: str) -> dict[KeyPath, str]:
    """The comment of every value of a valid TOML text; empty if there is none.

    A value's comment is the one behind it, else the comment lines directly above it, else those directly
    below the header of its table.
    """
    import tomlkit

    comments: dict[KeyPath, str] = {}
    _collect_comments(tomlkit.parse(text).body, (), comments)
    return comments


def _collect_comments(
    body: Iterable[tuple["Key | None", "Item"]],
    table: KeyPath,
    comments: dict[KeyPath, str],
    *,
    of_table: str = "",
    is_below_header: bool = False,
) -> None:
    """Adds the comments of a table's values; `of_table` is for values without their own."""
    from tomlkit.items import AoT, Comment, Table

    above: list[str] = []
    for key, item in body:
        if key is None:
            if isinstance(item, Comment):
                above.append(_comment(item))
            else:  # an empty line
                above, is_below_header = [], False
            continue
        place = (*table, key.key)
        of_table = " ".join(above) if is_below_header else of_table
        if isinstance(item, AoT):
            for member in item.body:
                _collect_comments(member.value.body, place, comments, is_below_header=True)
        elif isinstance(item, Table) and item.display_name is not None:  # it has a header
            _collect_comments(item.value.body, place, comments, is_below_header=True)
        elif isinstance(item, Table):  # of a dotted key
            _collect_comments(item.value.body, place, comments, of_table=" ".join(above) or of_table)
        else:
            comment = _comment(item) or " ".join(above) or of_table
            comments |= {(*table, *path): comment for path, _ in leaves({key.key: item.unwrap()})}
        above, is_below_header = [], False


def _comment(item: "Item") -> str:
    return item.trivia.comment[1:].strip()


@dataclass(frozen=True)
class EnvironmentList:
    """The environments of all installed packages.

    Attributes:
        environments: name, dimensions, horizon and task counts, by name.
        broken: one line of error, by name of plug-in or environment.
    """

    environments: tuple[dict[str, Any], ...]
    broken: dict[str, str]


def list_environments() -> EnvironmentList:
    """Every environment that has a recipe; those that fail are listed as broken."""
    rows, broken = [], ENVIRONMENTS.broken()
    for name in ENVIRONMENTS.members():
        try:
            if ENVIRONMENTS.get(name).recipe_file(name).is_file():
                rows.append(_row(name))
        except TcmrlError as error:
            broken[name] = str(error)
        except Exception as error:  # noqa: BLE001 # another package's code may raise anything
            broken[name] = f"environment {name!r} is broken: {one_line_error(error)}"
    return EnvironmentList(tuple(rows), broken)


def _row(name: str) -> dict[str, Any]:
    environment = load_recipe(name).make_environment()
    settings = environment.settings
    return {
        "name": name,
        "observation_dim": environment.observation_dim,
        "action_dim": environment.action_dim,
        "horizon": settings.horizon,
        "tasks": settings.tasks,
        "train": settings.train,
        "test": settings.tasks - settings.train,
    }
