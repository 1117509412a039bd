"""The `[training]` table of a recipe, resolved: what a run does, validated once."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import TcmrlError, TrainingError, apply_overrides, first_problem, plugin

ALGORITHMS = "tcmrl_algo.algorithms"
Table = TypeVar("Table", bound=BaseModel)


class TrainingConfig(BaseModel):
    """A resolved run: the shared settings and the chosen method's own table.

    Attributes:
        settings: the shared tables.
        method: the table named after the algorithm, as its module's `Config` dumps it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    settings: TrainingSettings
    method: dict[str, Any]


def resolve(
    table: Mapping[str, Any], *, place: str, algorithm: str | None = None, overrides: Sequence[str] = ()
) -> TrainingConfig:
    """The run that a recipe's training table asks for.

    Args:
        table: `[training]` of one profile.
        place: names the table's origin in errors.
        algorithm: instead of the table's `run.algorithm`.
        overrides: `section.key=value` texts, applied last.

    Raises:
        TrainingError: an unknown key or a wrong type.
        TcmrlError: no such algorithm.
    """
    tables = apply_overrides(table, overrides)
    run = tables.get("run", {})
    if algorithm is not None and isinstance(run, Mapping):
        tables["run"] = {**run, "algorithm": algorithm}
    shared = {name: tables.pop(name) for name in TrainingSettings.model_fields if name in tables}
    settings = validated(TrainingSettings, shared, place)
    kind: type[BaseModel] = plugin(ALGORITHMS, "algorithm", settings.run.algorithm).Config
    for name in sorted(tables):
        _check_method_table(name, place)
    method = validated(kind, tables.get(settings.run.algorithm, {}), f"{place}, [{settings.run.algorithm}]")
    return TrainingConfig(settings=settings, method=method.model_dump(mode="json"))


def _check_method_table(name: str, place: str) -> None:
    try:
        plugin(ALGORITHMS, "algorithm", name)
    except TcmrlError:
        known = ", ".join(TrainingSettings.model_fields)
        raise TrainingError(
            f"{place}: unknown table {name!r}; known are {known}, and one named after each algorithm"
        ) from None


def validated(kind: type[Table], values: Mapping[str, Any], place: str) -> Table:
    """The values as a settings object; strict, but for lists that stand for tuples.

    Raises:
        TrainingError: with the first complaint in one line.
    """
    try:
        return kind.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        raise TrainingError(f"{place}: {first_problem(error)}") from None
