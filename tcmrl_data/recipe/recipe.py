"""Recipes: TOML files, resolved once into a validated, frozen configuration."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES, BehaviorSource
from tcmrl_data.envs.base import ENVIRONMENTS, Environment, Reward, TaskSplit, make_environment
from tcmrl_data.envs.controller import View
from tcmrl_data.envs.foreign import Foreign
from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.errors import RecipeError, TcmrlError
from tcmrl_data.foundation.records import validate_table
from tcmrl_data.recipe.about import About, licence_problem, read_about
from tcmrl_data.recipe.document import merge_tables, open_recipe, read_override
from tcmrl_data.recipe.profile import Profile


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


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


class NoRollouts(Rollouts):
    """The rollouts of a run whose episodes come from elsewhere: none."""

    episodes: Literal[0] = 0
    lanes: Literal[0] = 0

    @model_validator(mode="after")
    def _full_lane_batches(self) -> "NoRollouts":
        return self


class TaskChoice(_Table):
    """The `[build]` table: which tasks, and what a unit takes; no part of any digest.

    Attributes:
        train_tasks: how many, evenly spaced along the environment's ordering; all where unset.
        test_tasks: how many, as the training tasks; all where unset.
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


class EnvironmentTable(_Table):
    """The `[environment]` table with the fields that all families share; `EnvironmentSettings` explains them.

    The family's own fields are kept as they are, so that a manifest can be read where the environment's
    package is not installed; `make_environment` validates them.
    """

    model_config = ConfigDict(frozen=True, extra="allow", strict=True)

    name: str
    task_seed: int
    tasks: int
    train: int
    horizon: int
    reward_density: Literal["dense", "sparse"]
    split: TaskSplit = "permutation"


class BehaviorTable(_Table):
    """The `[behavior]` table with the chosen source's settings.

    Attributes:
        source: name of the behavior source.
        observation: view that the behavior policies see.
        reward: reward that they learn from.
        settings: of the source; kept as they are, `make_source` validates them.
    """

    source: str
    observation: View = "stored"
    reward: Reward = "stored"
    settings: dict[str, Any]


class _UnitSettings(_Table):
    """The tables of a recipe that determine the data of a part."""

    environment: EnvironmentTable
    behavior: BehaviorTable
    rollouts: Rollouts


class Recipe(_Table):
    """A resolved recipe: one environment, one profile, one behavior source.

    Attributes:
        training: per profile, the training defaults that go with the data; validated by `tcmrl train`.
    """

    profile: Profile
    about: About
    environment: EnvironmentTable
    behavior: BehaviorTable
    rollouts: NoRollouts | Rollouts
    build: TaskChoice
    training: dict[Profile, dict[str, Any]]

    def unit_settings(self) -> dict[str, Any]:
        """Everything that determines the data of a part, beside task and seed."""
        return self.model_dump(mode="json", include={"environment", "behavior", "rollouts"})

    def make_environment(self) -> Environment:
        """The recipe's environment."""
        return make_environment(self.environment.model_dump(mode="json"))

    def make_source(self) -> BehaviorSource:
        """The recipe's behavior source with its settings."""
        kind = BEHAVIOR_SOURCES.get(self.behavior.source)
        return kind(kind.Settings.model_validate_json(canonical_json(self.behavior.settings)))


def load_recipe(
    name_or_file: str | Path,
    *,
    profile: Profile = "paper",
    overrides: Sequence[str] = (),
    behavior: str | None = None,
) -> Recipe:
    """The recipe of an environment, or a recipe file, resolved.

    Args:
        name_or_file: the environment, such as `point-robot` or `ml1/reach`, or the path of a recipe file,
            whose name ends in `.toml`.
        profile: `paper` is the recipe as written; another merges its `[profiles.<name>]` tables on top.
        overrides: `section.key=value` texts, applied last.
        behavior: behavior source instead of the recipe's.

    Raises:
        UnknownNameError: no such environment or behavior source.
        RecipeError: no such file, a profile that the recipe lacks, an unknown key, a wrong type, or values
            that contradict each other.
    """
    document = open_recipe(name_or_file)
    _check_overrides(overrides)
    tables = document.tables(profile, overrides)
    if behavior is not None:
        tables["behavior"]["source"] = behavior
    place = f"{document.place}, profile {profile!r}"
    validated = functools.partial(validate_table, place=place, error=RecipeError)
    kind = ENVIRONMENTS.get(document.environment)
    named = tables["environment"] | {"name": document.environment}
    environment = validated(kind.Settings, named, table="environment")
    kind(environment)  # refuses settings that the family as a whole does not allow
    training = {name: document.tables(name).get("training", {}) for name in document.profiles}
    return Recipe(
        profile=profile,
        about=read_about(tables["about"], place),
        environment=EnvironmentTable.model_validate(environment.model_dump(mode="json")),
        behavior=_behavior_table(tables["behavior"], place),
        rollouts=validated(Rollouts, tables["rollouts"], table="rollouts"),
        build=validated(TaskChoice, tables.get("build", {}), table="build"),
        training=training | {profile: tables.get("training", {})},
    )


def full_settings(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Unit settings that a manifest or a part recorded, with the defaults of the fields that they lack.

    A field that was added later thus makes no difference where it has its default, which must give the data
    that were made before. The result compares with `Recipe.unit_settings`.

    Args:
        recorded: the result of `Recipe.unit_settings`, by this version or an older one.

    Raises:
        UnknownNameError: an environment or behavior source that is not installed.
        RecipeError: a key that this version does not know, or a value that is not valid.
    """
    validated = functools.partial(validate_table, place="recorded settings", error=RecipeError)
    tables = validated(_UnitSettings, recorded)
    source = tables.behavior
    kind, source_kind = ENVIRONMENTS.get(tables.environment.name), BEHAVIOR_SOURCES.get(source.source)
    environment = validated(kind.Settings, recorded["environment"], table="environment")
    settings = validated(source_kind.Settings, source.settings, table="behavior.settings")
    return tables.model_dump(mode="json") | {
        "environment": environment.model_dump(mode="json"),
        "behavior": source.model_dump(mode="json") | {"settings": settings.model_dump(mode="json")},
    }


def same_settings(recorded: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two recorded unit settings are equal, with defaults where they lack a field.

    Settings that this version cannot read are equal only if they are written alike.
    """
    if recorded == other:
        return True
    try:
        return full_settings(recorded) == full_settings(other)
    except TcmrlError:
        return False


def _check_overrides(overrides: Sequence[str]) -> None:
    """Refuses an override of the environment's name, which would have no effect."""
    for text in overrides:
        if read_override(text)[0] == ["environment", "name"]:
            raise RecipeError(f"--set {text!r}: a recipe is for one environment; name another one as ENV")


class _Behavior(_Table):
    """What a recipe file says in `[behavior]` itself."""

    source: str
    observation: View = "stored"
    reward: Reward = "stored"


def _behavior_table(tables: Mapping[str, Any], place: str) -> BehaviorTable:
    """`[behavior]` with the settings of the source: its own table on top of that of the one it extends."""
    plain = {key: value for key, value in tables.items() if not isinstance(value, Mapping)}
    own = validate_table(_Behavior, plain, place=place, error=RecipeError, table="behavior")
    kind = BEHAVIOR_SOURCES.get(own.source)
    table = f"behavior.{own.source}"
    if not isinstance(tables.get(own.source), Mapping):
        raise RecipeError(f"{place}: behavior source {own.source!r} has no [{table}] table")
    extended = tables.get(kind.extends or own.source, {})
    values = merge_tables(extended if isinstance(extended, Mapping) else {}, tables[own.source])
    settings = validate_table(kind.Settings, values, place=place, error=RecipeError, table=table)
    return BehaviorTable(**own.model_dump(), settings=settings.model_dump(mode="json"))


UNKNOWN = "unknown"
UNKNOWN_BEHAVIOR = BehaviorTable(source=UNKNOWN, settings={})
"""Of episodes whose policies nobody has described; no behavior source has this name."""


def foreign_recipe(
    *,
    tasks: int,
    train: int,
    horizon: int,
    observation_dim: int,
    action_dim: int,
    extra_arrays: Mapping[str, str],
    licence: str | None,
) -> Recipe:
    """The recipe of data of an unknown environment.

    A manifest always has a recipe: that is where samplers, exports, `inspect` and training look for sizes,
    horizon and training tables, which thus need no second path for imported data.

    Args:
        tasks: number of tasks.
        train: number of training tasks.
        horizon: steps of the longest episode.
        observation_dim: width of observations.
        action_dim: width of actions.
        extra_arrays: dtypes of further per-step arrays, by name.
        licence: of the data; None where it is not known.
    """
    environment = {
        "name": Foreign.name,
        "task_seed": 0,
        "tasks": tasks,
        "train": train,
        "horizon": horizon,
        "reward_density": "dense",
        "observation_dim": observation_dim,
        "action_dim": action_dim,
        "extra_arrays": dict(extra_arrays),
    }
    return Recipe(
        profile="paper",
        about=About(
            description="data of an environment that is not known here",
            citation=UNKNOWN,
            licence=licence or UNKNOWN,
        ),
        environment=EnvironmentTable.model_validate(environment),
        behavior=UNKNOWN_BEHAVIOR,
        rollouts=NoRollouts(),
        build=TaskChoice(),
        training={"paper": {}},
    )


def bound_recipe(environment: str, *, licence: str | None) -> Recipe:
    """The recipe of data that come from one of our environments, but not from a build of it.

    Args:
        environment: its name.
        licence: of the data; None where it is not known.

    Raises:
        UnknownNameError: there is no such environment.
    """
    recipe = load_recipe(environment)
    return recipe.model_copy(
        update={
            "about": recipe.about.model_copy(
                update={
                    "citation": UNKNOWN,
                    "licence": licence or UNKNOWN,
                    "authors": (),
                    "url": None,
                    "doi": None,
                }
            ),
            "behavior": UNKNOWN_BEHAVIOR,
            "rollouts": NoRollouts(),
            "build": TaskChoice(),
        }
    )


def check_licence(licence: str | None) -> None:
    """Checks the licence that someone gives for data from elsewhere.

    Raises:
        RecipeError: SPDX does not know it.
    """
    problem = None if licence is None else licence_problem(licence)
    if problem:
        raise RecipeError(f"licence: {problem}")
