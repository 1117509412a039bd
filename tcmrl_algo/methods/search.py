"""Search spaces: which values of a training table `tcmrl tune` tries; every method declares its own."""

from collections.abc import Mapping
from dataclasses import dataclass

SettingValue = bool | int | float | str
"""A value of a training table that may be searched for."""


@dataclass(frozen=True)
class Options:
    """Some values of a setting; that of the training table is always among them.

    Attributes:
        values: the others, or all of them.
    """

    values: tuple[SettingValue, ...]


@dataclass(frozen=True)
class Factors:
    """A positive number of the training table times a factor, so that one space fits every environment.

    Attributes:
        low, high: range of the factor, around 1, which is drawn on a logarithmic scale.
    """

    low: float
    high: float


Search = Mapping[str, Options | Factors]
"""What is searched, by `section.key` as `--set` names it."""

SHARED_SEARCH: Search = {
    "optimizer.learning_rate": Factors(1 / 3, 3.0),
    "actor_critic.entropy": Factors(0.1, 10.0),
}
"""What all methods search that train the shared actor-critic, by equal ranges; a method may add to it."""
