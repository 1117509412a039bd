"""Engines run units somewhere, one engine a file."""

import abc
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.plugins import Registry

ATTEMPTS = 2
"""A unit that crashed or ran out of time is tried once more; an error that it reports itself is final."""

Message = Callable[[str, Mapping[str, Any]], None]
"""Receives (unit id, message) as units report; messages tell of progress, and may get lost."""


@dataclass(frozen=True)
class Unit:
    """Work for one process; running it twice does no harm.

    Attributes:
        id: names the unit in messages and logs.
        spec: JSON, understood by the worker.
        worker: the module that does it, run as a process of its own; it serves by `serve`.
        threads: of that process's libraries.
        cost: relative length, for starting the longest first.
        cpus: cores to reserve, on engines that know several machines.
        gpus: graphics processors to reserve there; a fraction shares one.
        memory: bytes to reserve there.
        timeout: seconds after which an attempt is ended; None for no limit.
    """

    id: str
    spec: Mapping[str, Any]
    worker: str
    threads: int = 1
    cost: float = 1.0
    cpus: float = 1.0
    gpus: float = 0.0
    memory: int = 0
    timeout: float | None = None


@dataclass(frozen=True)
class Result:
    """How a unit ended.

    Attributes:
        id: the unit.
        ok: it is done.
        digest: what the worker returned for the work done, where ok: equal work, equal digest.
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
    """Runs units, each at least once, in any order; a plug-in of the entry point group `tcmrl.engines`.

    Args:
        workers: units at a time; as many as there is room for where None.
        address: of the machines to work on, for engines that reach others.

    Raises:
        BuildError: the engine takes no address.
    """

    name: ClassVar[str]
    takes_address: ClassVar[bool] = False
    """Whether the engine reaches other machines, at an address."""

    def __init__(self, workers: int | None = None, *, address: str | None = None) -> None:
        if address is not None and not self.takes_address:
            raise BuildError(f"this engine takes no address, got {address!r}; leave it out or choose ray")
        self.workers, self.address = workers, address

    @abc.abstractmethod
    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        """Yields one result per unit as units end; closing the iterator ends what still runs.

        Raises:
            BuildError: a unit asks for more than any machine has; nothing was started.
        """


ENGINES = Registry("tcmrl.engines", "engine", BaseEngine)


def longest_first(units: Sequence[Unit]) -> list[Unit]:
    """The units in the order in which they are started: the last one to end should be a short one."""
    return sorted(units, key=lambda unit: -unit.cost)
