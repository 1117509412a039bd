"""The `[training]` table of a recipe, resolved: what a run does, validated once."""

from collections.abc import Mapping, Sequence
from typing import Any

from tcmrl_algo.algorithms.core.method import METHODS, Method
from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_algo.algorithms.core.settings import (
    PROTOCOL_GROUP,
    TrainingConfig,
    TrainingSettings,
    TrainingSource,
)
from tcmrl_data import Dataset, Profile, TrainingError, apply_overrides, load_recipe
from tcmrl_data.foundation.errors import RecipeError, UnknownNameError
from tcmrl_data.foundation.plugins import check_declared
from tcmrl_data.foundation.records import validate_table


def resolve(
    table: Mapping[str, Any],
    *,
    place: str,
    algorithm: str | None = None,
    overrides: Sequence[str] = (),
    fallback: Mapping[str, Any] | None = None,
) -> TrainingConfig:
    """The run that a recipe's training table describes.

    Args:
        place: names the table's origin in errors.
        algorithm: instead of the table's `run.algorithm`.
        overrides: `section.key=value` texts, applied last.
        fallback: another training table, for a method of which the first one knows nothing; only the
            method's own table is taken from it.

    Raises:
        TrainingError: an unknown key, a wrong type, an unknown protocol, or stages whose steps do not sum
            to `run.steps`.
        UnknownNameError: no such algorithm.
    """
    run = apply_overrides(table, overrides).get("run", {})
    chosen = algorithm or (run.get("algorithm") if isinstance(run, Mapping) else None) or "tcmrl"
    source: TrainingSource = "table" if chosen in table else "defaults"
    if source == "defaults" and fallback is not None and chosen in fallback:
        table, source = {**table, chosen: fallback[chosen]}, "recipe"
    tables = apply_overrides(table, overrides)
    if algorithm is not None and isinstance(run, Mapping):
        tables["run"] = {**run, "algorithm": algorithm}
    shared = {name: tables.pop(name) for name in TrainingSettings.model_fields if name in tables}
    settings = validate_table(TrainingSettings, shared, place=place, error=TrainingError)
    _check_protocol(settings.run.protocol, place)
    name = settings.run.algorithm
    kind = METHODS.get(name).Config
    _check_names(tables, place)
    own = validate_table(kind, tables.get(name, {}), place=place, error=TrainingError, table=name)
    config = TrainingConfig(settings=settings, method=own.model_dump(mode="json"), training_source=source)
    stage_plan(config)
    return config


def _check_protocol(name: str, place: str) -> None:
    try:
        check_declared(PROTOCOL_GROUP, "protocol", name)
    except UnknownNameError as error:
        raise TrainingError(f"{place}, run.protocol: {error}") from None


def resolve_for(
    dataset: Dataset, *, profile: Profile, algorithm: str | None = None, overrides: Sequence[str] = ()
) -> TrainingConfig:
    """The run on a dataset: by the training table that its manifest keeps of the recipe it was built by.

    A method that is newer than the dataset has no table there. It gets the one of the installed recipe of
    the same environment and profile, where there is one, and its own defaults otherwise;
    `TrainingConfig.training_source` says which.

    Raises:
        TrainingError: no such profile, or as of `resolve`.
        UnknownNameError: no such algorithm.
    """
    known = dataset.manifest.training
    if profile not in known:
        raise TrainingError(f"{dataset.path} has no training table {profile!r}; known are {', '.join(known)}")
    return resolve(
        known[profile],
        place=f"training table of {dataset.name!r}, profile {profile!r}",
        algorithm=algorithm,
        overrides=overrides,
        fallback=installed_table(dataset.name, profile),
    )


def installed_table(environment: str, profile: str) -> Mapping[str, Any]:
    """The training table of an environment's installed recipe; empty where there is none of that profile."""
    try:
        tables = load_recipe(environment).training
    except (UnknownNameError, RecipeError):  # built by a user's recipe file
        return {}
    return {str(name): table for name, table in tables.items()}.get(profile, {})


def method_of(config: TrainingConfig) -> tuple[Method[Any], Any]:
    """The method of a run, and its own settings.

    Raises:
        UnknownNameError: no installed package declares it.
        TrainingError: its settings are not what this version of it reads.
    """
    name = config.settings.run.algorithm
    kind = METHODS.get(name)
    own = validate_table(
        kind.Config, config.method, place="run.json", error=TrainingError, table="config.method"
    )
    return kind(), own


def stage_plan(config: TrainingConfig) -> StagePlan:
    """The stages of a run.

    Raises:
        TrainingError: their steps do not sum to `run.steps`.
    """
    method, own = method_of(config)
    return StagePlan(method.stages(config.settings, own), steps=config.settings.run.steps)


def _check_names(tables: Mapping[str, Any], place: str) -> None:
    """Every remaining table must be named after an algorithm."""
    for name in sorted(set(tables) - set(METHODS.names())):
        known = ", ".join(TrainingSettings.model_fields)
        raise TrainingError(
            f"{place}: unknown table {name!r}; known are {known}, and tables named after an algorithm"
        )
