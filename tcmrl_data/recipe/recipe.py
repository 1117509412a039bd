"""Recipes: TOML files, resolved once into a validated, frozen configuration, and the tasks they choose."""

import functools
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES, BehaviorSource
from tcmrl_data.envs.base import (
    ENVIRONMENTS,
    Environment,
    Reward,
    Task,
    TaskSplit,
    draw_tasks,
    in_order,
    make_environment,
)
from tcmrl_data.envs.rollout import ObservationView
from tcmrl_data.foundation.errors import RecipeError, TaskError, TcmrlError
from tcmrl_data.foundation.records import as_model, missing_fields, validate_table
from tcmrl_data.recipe import Profile
from tcmrl_data.recipe.document import (
    About,
    merge_tables,
    open_recipe,
    read_about,
    read_override,
)


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Rollouts(_Table):
    """The `[rollouts]` table.

    Attributes:
        episodes: stochastic trajectories per snapshot (paper, Appendix F.1: 50).
        lanes: episodes stepped together; part of the data's identity, because the batch size of a network
            call affects rounding.
    """

    episodes: int = Field(ge=1)
    lanes: int = Field(ge=1)

    @model_validator(mode="after")
    def _full_lane_batches(self) -> "Rollouts":
        if self.episodes % self.lanes:
            raise ValueError(f"episodes ({self.episodes}) must be a multiple of lanes ({self.lanes})")
        return self


ROLLOUTS = {"episodes": 50, "lanes": 10}
"""What a recipe file need not say: the paper's number of episodes (Appendix F.1)."""


class NoRollouts(Rollouts):
    """The rollouts of imported data: none."""

    episodes: Literal[0] = 0
    lanes: Literal[0] = 0

    @model_validator(mode="after")
    def _full_lane_batches(self) -> "NoRollouts":
        return self


class TaskChoice(_Table):
    """The `[build]` table: the tasks, and the resources of a unit (a task or group of tasks).

    It is not part of any digest.

    Attributes:
        train_tasks: number of training tasks, evenly spaced along the environment's ordering; all by default.
        test_tasks: number of test tasks, likewise.
        cpus: cores that a cluster reserves for a unit.
        gpus: GPUs that a cluster reserves for a unit; a fraction shares one.
        memory: bytes that a cluster reserves for a unit, if this is more than planned.
        timeout: seconds after which an attempt at a unit is stopped; no limit by default.
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
        observation: view that the behavior policies receive.
        reward: reward that they are trained on.
        settings: the source's settings as they were recorded; `make_source` validates them.
    """

    source: str
    observation: ObservationView = "stored"
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
        training: training defaults by profile; `tcmrl train` validates them.
    """

    profile: Profile
    about: About
    environment: EnvironmentTable
    behavior: BehaviorTable
    rollouts: NoRollouts | Rollouts
    build: TaskChoice
    training: dict[Profile, dict[str, Any]]

    def unit_settings(self) -> dict[str, Any]:
        """Everything except task and seed that determines the data of a part."""
        return self.model_dump(mode="json", include={"environment", "behavior", "rollouts"})

    def make_environment(self) -> Environment:
        """The recipe's environment."""
        return make_environment(self.environment.model_dump(mode="json"))

    def make_source(self) -> BehaviorSource:
        """The recipe's behavior source with its settings."""
        kind = BEHAVIOR_SOURCES.get(self.behavior.source)
        return kind(as_model(kind.Settings, self.behavior.settings))


def load_recipe(
    name_or_file: str | Path,
    *,
    profile: Profile = "paper",
    overrides: Sequence[str] = (),
    behavior: str | None = None,
) -> Recipe:
    """Loads and resolves the recipe of an environment, or a recipe file.

    Args:
        name_or_file: the environment, such as `point-robot` or `ml1/reach`, or the path of a recipe file,
            whose name ends in `.toml`.
        profile: `paper` is the recipe as written; another merges its `[profiles.<name>]` tables on top.
        overrides: `section.key=value` texts, applied last.
        behavior: behavior source instead of the recipe's.

    Raises:
        UnknownNameError: no such environment or behavior source.
        RecipeError: the file or the profile does not exist, a key is unknown, or values have a wrong type or
            contradict each other.
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
    own, source, settings = _behavior(tables["behavior"], place)
    table = f"behavior.{own.source}"
    lacking = [
        *missing_fields(About, tables["about"], table="about"),
        *missing_fields(kind.Settings, named, table="environment"),
        *missing_fields(source.Settings, settings, table=table),
    ]
    if lacking:
        raise RecipeError(f"{place} lacks {', '.join(lacking)}; add {'them' if lacking[1:] else 'it'}")
    environment = validated(kind.Settings, named, table="environment")
    kind(environment)  # refuses settings that the family as a whole does not allow
    full = validated(source.Settings, settings, table=table).model_dump(mode="json")
    return Recipe(
        profile=profile,
        about=read_about(tables["about"], place),
        environment=EnvironmentTable.model_validate(environment.model_dump(mode="json")),
        behavior=BehaviorTable(**own.model_dump(), settings=full),
        rollouts=validated(Rollouts, ROLLOUTS | tables["rollouts"], table="rollouts"),
        build=validated(TaskChoice, tables["build"], table="build"),
        training={name: document.tables(name)["training"] for name in document.profiles}
        | {profile: tables["training"]},
    )


def full_settings(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Completes recorded unit settings by defaults, for comparison with `Recipe.unit_settings`.

    A manifest or part of an older version lacks fields that were added later. The default of such a field
    must give the same data as before.

    Raises:
        RecipeError: a key is unknown to this version, or a value is invalid.
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
    """Whether two recorded unit settings are equal, with defaults for missing fields.

    Settings that this version cannot read are equal only if their values are.
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
    """The `[behavior]` table of a recipe file, without the tables of sources."""

    source: str = "stacked"
    observation: ObservationView = "stored"
    reward: Reward = "stored"


def _behavior(
    tables: Mapping[str, Any], place: str
) -> tuple[_Behavior, type[BehaviorSource], dict[str, Any]]:
    """`[behavior]`, its source, and the source's table on top of that of the source that it extends."""
    plain = {key: value for key, value in tables.items() if not isinstance(value, Mapping)}
    own = validate_table(_Behavior, plain, place=place, error=RecipeError, table="behavior")
    kind = BEHAVIOR_SOURCES.get(own.source)
    given: dict[str, Any] = {}
    for name in (kind.extends or own.source, own.source):
        given = merge_tables(given, tables[name]) if isinstance(tables.get(name), Mapping) else given
    return own, kind, given


def spread(tasks: Sequence[Task], *, num_train: int, num_test: int, is_circular: bool = False) -> list[int]:
    """Indices, ascending, of `num_train` training and `num_test` test tasks, evenly spaced in their split.

    Tasks are given in the order in which they are spaced. A selection contains the first and the last task of
    a split, so that it covers the same range; on a circle, where these are neighbors, only the first.
    """
    chosen: list[int] = []
    for split, number in (("train", num_train), ("test", num_test)):
        members = [task.index for task in tasks if task.split == split]
        if number > len(members):
            raise TaskError(f"{number} {split} tasks asked for, the task set has {len(members)}")
        last = len(members) if is_circular else len(members) - 1
        positions = np.linspace(0, last, number, endpoint=not is_circular).round().astype(int)
        chosen.extend(members[position] for position in positions)
    return sorted(chosen)


def choose_tasks(
    recipe: Recipe, indices: Sequence[int] | None = None, *, environment: Environment | None = None
) -> list[Task]:
    """The tasks with the given indices, or else those of the recipe's profile, ascending.

    A profile's tasks are evenly spaced along the environment's ordering, or by index if it has none.

    Args:
        indices: of the tasks; None for the profile's choice.
        environment: the recipe's, if it was made before.

    Raises:
        TaskError: an index does not exist, or the profile has more tasks than the task set.
    """
    environment = environment or recipe.make_environment()
    tasks = draw_tasks(environment)
    if indices is None:
        num_train, num_test = (
            sum(task.split == split for task in tasks) if wanted is None else wanted
            for split, wanted in (("train", recipe.build.train_tasks), ("test", recipe.build.test_tasks))
        )
        indices = spread(
            in_order(environment, tasks),
            num_train=num_train,
            num_test=num_test,
            is_circular=environment.is_circular,
        )
    for index in indices:
        if not 0 <= index < len(tasks):
            raise TaskError(f"task index {index} does not exist, the tasks are 0-{len(tasks) - 1}")
    return [tasks[index] for index in sorted(set(indices))]


def group_tasks(tasks: Iterable[Task], group_size: int) -> list[tuple[Task, ...]]:
    """Groups of the tasks with equal index // group_size, ascending; the machine does not affect them."""
    ordered = sorted(tasks, key=lambda task: task.index)
    return [tuple(group) for _, group in groupby(ordered, key=lambda task: task.index // group_size)]


def parse_indices(text: str, num_tasks: int, *, option: str = "--tasks") -> list[int]:
    """The sorted indices in a text such as `0-9,12`.

    Raises:
        TaskError: the text is not a list of indices and ranges, or an index does not exist; the message
            names the option.
    """
    indices: set[int] = set()
    for item in text.split(","):
        first, dash, last = item.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise TaskError(f"{option} {text!r}: {item!r} is neither an index nor a range such as 0-9")
        start, stop = int(first), int(last or first)
        if stop < start:
            raise TaskError(f"{option} {text!r}: the range {item!r} runs backwards")
        if stop >= num_tasks:
            raise TaskError(f"{option} {text!r}: {stop} is too large, 0-{num_tasks - 1} are possible")
        indices.update(range(start, stop + 1))
    return sorted(indices)
