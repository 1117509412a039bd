"""Engines run units somewhere, one engine a file: each module has NAME and a class Engine(workers)."""

import abc
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Message = Callable[[str, Mapping[str, Any]], None]
"""Receives (unit id, message) as units report."""


@dataclass(frozen=True)
class Unit:
    """Work for one process; running it twice does no harm.

    Attributes:
        id: names the unit in messages and logs.
        spec: JSON, understood by `tcmrl_data.unit`.
        cost: relative length, for starting the longest first.
        timeout: seconds after which an attempt is ended; None for no limit.
    """

    id: str
    spec: Mapping[str, Any]
    cost: float = 1.0
    timeout: float | None = None


@dataclass(frozen=True)
class Result:
    """How a unit ended.

    Attributes:
        id: the unit.
        ok: it is done.
        digest: digest over the unit's part ids, where ok.
        error: one line, where not ok.
        attempt: attempts made, from 1.
        node: host that ran the last attempt.
    """

    id: str
    ok: bool
    digest: str | None
    error: str | None
    attempt: int
    node: str


class BaseEngine(abc.ABC):
    """Runs units, each at least once, in any order."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    @abc.abstractmethod
    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        """Yields one result per unit as units end; closing the iterator stops what still runs."""
