"""A method's search space on one training table: what a trial may draw, and the values that this gives."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from tcmrl_algo.algorithms.core.method import Factors, Search, SettingValue
from tcmrl_algo.training.config import TrainingConfig
from tcmrl_data import TrainingError

SIGNIFICANT_DIGITS = 3
"""Of values that a factor gives: more would only make overrides longer."""


class Dimension(BaseModel):
    """One searched setting.

    Attributes:
        kind: `options` draws one of `options`; `factors` draws a factor from `low` to `high`.
        own: the training table's value, which the first trial takes.
        options: all of them; none for `factors`.
        low, high: range of the factor; None for `options`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["options", "factors"]
    own: SettingValue
    options: tuple[SettingValue, ...] = ()
    low: float | None = None
    high: float | None = None

    @property
    def first(self) -> SettingValue:
        """What the first trial draws."""
        return self.own if self.kind == "options" else 1.0

    def value(self, drawn: SettingValue) -> SettingValue:
        """The setting's value where `drawn` was drawn."""
        if self.kind == "options":
            return drawn
        if drawn == self.first:
            return self.own
        return float(f"{float(self.own) * float(drawn):.{SIGNIFICANT_DIGITS}g}")


Space = Mapping[str, Dimension]
"""What is searched, by `section.key`."""


def space_on(config: TrainingConfig, search: Search) -> dict[str, Dimension]:
    """A method's search space around the values of a resolved training table.

    A factor of a number that is 0 changes nothing; such a setting is left out.

    Raises:
        TrainingError: a setting that the method does not have, or a factor of what is no number.
    """
    name = config.settings.run.algorithm
    table = config.settings.model_dump(mode="json") | {name: config.method}
    space = {}
    for key, what in search.items():
        own = _value_at(table, key, name)
        if not isinstance(what, Factors):
            options = what.values if own in what.values else (own, *what.values)
            space[key] = Dimension(kind="options", own=own, options=options)
        elif isinstance(own, bool | str) or own < 0:
            raise TrainingError(f"{name} searches factors of {key}, which is {own!r} and no positive number")
        elif own > 0:
            space[key] = Dimension(kind="factors", own=own, low=what.low, high=what.high)
    return space


def searched(search: Search, overrides: Sequence[str]) -> Search:
    """The search without the settings, or tables of settings, that an override gives a value."""
    fixed = tuple(f"{text.partition('=')[0].strip()}." for text in overrides)
    return {key: what for key, what in search.items() if not f"{key}.".startswith(fixed)}


def _value_at(table: Mapping[str, Any], key: str, algorithm: str) -> SettingValue:
    value: Any = table
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if not isinstance(value, bool | int | float | str):
        raise TrainingError(f"{algorithm} searches {key!r}, which is no setting with a single value")
    return value
