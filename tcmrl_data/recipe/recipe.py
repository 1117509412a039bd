"""Recipes: hand-written TOML in `manifests/`, resolved once into a validated, frozen configuration."""

import functools
import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources.abc import Traversable
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES, BehaviorSource
from tcmrl_data.envs.base import ENVIRONMENTS, Environment, make_environment
from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.foundation.validation import validate_table

Profile = Literal["paper", "quick", "reduced"]
PROFILES: tuple[Profile, ...] = ("paper", "quick", "reduced")
RECIPE_SCHEMA = 1
TABLES = {"about", "environment", "behavior", "rollouts", "build", "training"}


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class About(_Table):
    """What a dataset says of itself; no part of any digest."""

    description: str
    citation: str
    licence: str


class Rollouts(_Table):
    """The `[rollouts]` table.

    Attributes:
        episodes: stochastic trajectories per snapshot (paper, Appendix F.1: 50).
        lanes: episodes stepped together; part of the data's identity, since a batched network call
            rounds differently for another batch size.
    """

    episodes: int = Field(ge=1)
    lanes: int = Field(ge=1)

    @model_validator(mode="after")
    def _full_lane_batches(self) -> "Rollouts":
        if self.episodes % self.lanes:
            raise ValueError(f"episodes ({self.episodes}) must be a multiple of lanes ({self.lanes})")
        return self


class TaskChoice(_Table):
    """The `[build]` table: which tasks, and what a unit takes; no part of any digest.

    Attributes:
        train_tasks: how many, evenly spaced; all where unset.
        test_tasks: how many, evenly spaced; all where unset.
        cpus: cores that a cluster reserves for a unit, a task or a group of tasks.
        gpus: graphics processors that a cluster reserves for a unit; a fraction shares one.
        memory: bytes that a cluster reserves for a unit, where more than planned.
        timeout: seconds after which an attempt at a unit is ended; no limit where unset.
    """

    train_tasks: int | None = Field(default=None, ge=2)
    test_tasks: int | None = Field(default=None, ge=1)
    cpus: float = Field(default=1.0, gt=0)
    gpus: float = Field(default=0.0, ge=0)
    memory: int = Field(default=0, ge=0)
    timeout: float | None = Field(default=None, gt=0)


class Recipe(_Table):
    """A resolved recipe: one environment, one profile, one behavior source.

    Attributes:
        environment: validated `[environment]` table (a plain mapping, so that it digests as written).
        behavior: `{"source", "observation", "reward", "settings"}`; settings are the chosen source's.
        training: per profile, the training defaults that go with the data; validated by `tcmrl train`.
    """

    profile: Profile
    about: About
    environment: dict[str, Any]
    behavior: dict[str, Any]
    rollouts: Rollouts
    build: TaskChoice
    training: dict[Profile, dict[str, Any]]

    def unit_settings(self) -> dict[str, Any]:
        """Everything that determines the data of a part, beside task and seed."""
        return {
            "environment": self.environment,
            "behavior": self.behavior,
            "rollouts": self.rollouts.model_dump(),
        }

    def make_environment(self) -> Environment:
        """The recipe's environment."""
        return make_environment(self.environment)

    def make_source(self) -> BehaviorSource:
        """The recipe's behavior source with its settings."""
        kind = BEHAVIOR_SOURCES.get(self.behavior["source"])
        return kind(kind.Settings.model_validate_json(canonical_json(self.behavior["settings"])))


class _Behavior(_Table):
    source: str
    observation: Literal["stored", "full"] = "stored"
    reward: Literal["stored", "dense"] = "stored"


def load_recipe(
    name: str, *, profile: Profile = "paper", overrides: Sequence[str] = (), behavior: str | None = None
) -> Recipe:
    """The recipe of an environment, resolved.

    Args:
        name: the environment, such as `point-robot` or `ml1/reach`.
        profile: `paper` is the recipe as written; another merges its `[profiles.<name>]` tables on top.
        overrides: `section.key=value` texts, applied last.
        behavior: behavior source instead of the recipe's.

    Raises:
        UnknownNameError: no such environment or behavior source.
        RecipeError: a profile that the recipe lacks, an unknown key, a wrong type, or values that
            contradict each other.
    """
    kind = ENVIRONMENTS.get(name)
    document = _read(name)
    place = f"recipe of {name!r}, profile {profile!r}"
    if profile not in _profiles(document):
        raise RecipeError(
            f"recipe of {name!r} has no profile {profile!r}; known are {', '.join(_profiles(document))}"
        )
    tables = apply_overrides(_profile(document, profile), overrides)
    unknown = sorted(set(tables) - TABLES)
    if unknown:
        raise RecipeError(f"{place}: unknown table {unknown[0]!r}; known are {', '.join(sorted(TABLES))}")
    if behavior is not None:
        tables["behavior"]["source"] = behavior
    validated = functools.partial(validate_table, place=place, error=RecipeError)
    chosen = validated(_Behavior, _without_tables(tables["behavior"]), table="behavior")
    settings = _behavior_settings(tables["behavior"], chosen.source, place)
    environment = validated(kind.Settings, tables["environment"] | {"name": name}, table="environment")
    training = {each: _profile(document, each).get("training", {}) for each in _profiles(document)}
    training[profile] = tables.get("training", {})
    return Recipe(
        profile=profile,
        about=validated(About, tables["about"], table="about"),
        environment=environment.model_dump(mode="json"),
        behavior=chosen.model_dump() | {"settings": settings.model_dump(mode="json")},
        rollouts=validated(Rollouts, tables["rollouts"], table="rollouts"),
        build=validated(TaskChoice, tables.get("build", {}), table="build"),
        training=training,
    )


def apply_overrides(table: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of nested tables with `section.key=value` texts applied; values are read as TOML.

    Raises:
        RecipeError: a text without `=`, a value that is no TOML, or a section that is a plain value.
    """
    result = _merged({}, table)
    for text in overrides:
        path, equals, value = text.partition("=")
        keys = path.strip().split(".")
        if not equals or len(keys) < 2 or not all(keys):
            raise RecipeError(f"--set {text!r}: expected section.key=value, such as rollouts.episodes=10")
        try:
            parsed = tomllib.loads(f"value = {value.strip()}")["value"]
        except tomllib.TOMLDecodeError:
            parsed = value.strip()  # an unquoted word is a string
        section = result
        for key in keys[:-1]:
            section = section.setdefault(key, {})
            if not isinstance(section, dict):
                raise RecipeError(f"--set {text!r}: {key!r} is a value, not a section")
        section[keys[-1]] = parsed
    return result


def _behavior_settings(tables: Mapping[str, Any], source: str, place: str) -> BaseModel:
    """The source's settings: its own table, on top of that of the source whose settings it shares."""
    kind = BEHAVIOR_SOURCES.get(source)
    if source not in tables:
        raise RecipeError(f"{place}: behavior source {source!r} has no [behavior.{source}] table")
    values = _merged(tables.get(kind.extends or source, {}), tables[source])
    settings: BaseModel = validate_table(
        kind.Settings, values, place=place, error=RecipeError, table=f"behavior.{source}"
    )
    return settings


def _recipe_file(name: str) -> Traversable:
    return ENVIRONMENTS.get(name).recipe_file(name)


def _read(name: str) -> dict[str, Any]:
    file = _recipe_file(name)
    if not file.is_file():
        raise RecipeError(f"environment {name!r} has no recipe {file.name!r} in manifests/")
    document = tomllib.loads(file.read_text(encoding="utf-8"))
    schema = document.pop("schema", None)
    if schema != RECIPE_SCHEMA:
        raise RecipeError(f"{file.name}: schema {schema!r} is not {RECIPE_SCHEMA}")
    return _merged(document, document.pop("variants", {}).get(name, {}))


def _profiles(document: Mapping[str, Any]) -> list[Profile]:
    """The profiles that a recipe has."""
    return [each for each in PROFILES if each == "paper" or each in document.get("profiles", {})]


def _profile(document: Mapping[str, Any], profile: Profile) -> dict[str, Any]:
    """The document's tables with the profile's merged on top."""
    tables = {key: value for key, value in document.items() if key != "profiles"}
    return _merged(tables, document.get("profiles", {}).get(profile, {}))


def _merged(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """Deep merge; tables merge, everything else is replaced."""
    result = {key: _merged({}, value) if isinstance(value, Mapping) else value for key, value in base.items()}
    for key, value in top.items():
        below = result.get(key)
        if isinstance(value, Mapping):
            result[key] = _merged(below if isinstance(below, Mapping) else {}, value)
        else:
            result[key] = value
    return result


def _without_tables(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if not isinstance(value, Mapping)}
