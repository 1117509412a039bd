"""The `[training]` table of a recipe, resolved: what a run does, validated once."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict

from tcmrl_algo.settings.run import PROTOCOL_GROUP
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import TcmrlError, TrainingError, apply_overrides, plugin
from tcmrl_data.foundation.errors import UnknownNameError
from tcmrl_data.foundation.plugins import check_declared
from tcmrl_data.foundation.validation import validate_table

ALGORITHMS = "tcmrl_algo.algorithms"


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
        TrainingError: an unknown key, a wrong type or an unknown protocol.
        TcmrlError: no such algorithm.
    """
    tables = apply_overrides(table, overrides)
    run = tables.get("run", {})
    if algorithm is not None and isinstance(run, Mapping):
        tables["run"] = {**run, "algorithm": algorithm}
    shared = {name: tables.pop(name) for name in TrainingSettings.model_fields if name in tables}
    settings = validate_table(TrainingSettings, shared, place=place, error=TrainingError)
    _check_protocol(settings.run.protocol, place)
    kind: type[BaseModel] = plugin(ALGORITHMS, "algorithm", settings.run.algorithm).Config
    for name in sorted(tables):
        _check_method_table(name, place)
    name = settings.run.algorithm
    method = validate_table(kind, tables.get(name, {}), place=place, error=TrainingError, table=name)
    return TrainingConfig(settings=settings, method=method.model_dump(mode="json"))


def _check_protocol(name: str, place: str) -> None:
    try:
        check_declared(PROTOCOL_GROUP, "protocol", name)
    except UnknownNameError as error:
        raise TrainingError(f"{place}, run.protocol: {error}") from None


def _check_method_table(name: str, place: str) -> None:
    try:
        plugin(ALGORITHMS, "algorithm", name)
    except TcmrlError:
        known = ", ".join(TrainingSettings.model_fields)
        raise TrainingError(
            f"{place}: unknown table {name!r}; known are {known}, and one named after each algorithm"
        ) from None
