"""Base class of engines, and the units and results that they exchange with a driver."""

import abc
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.plugins import Registry

ATTEMPTS = 2
"""Attempts per unit that crashes or exceeds its timeout; an error that a unit reports is final."""

Message = Callable[[str, Mapping[str, Any]], None]
"""Receives (unit id, message); messages report progress and may be lost."""


@dataclass(frozen=True)
class Unit:
    """Work for one process. A unit may run more than once.

    Attributes:
        worker: module whose `work` the process calls, see `tcmrl_data.engine.local`.
        threads: threads of the process's numerical libraries.
        cost: relative duration; the longest unit starts first.
        cpus: cores to reserve, on engines that use several machines.
        gpus: GPUs to reserve on those engines; units may share one by fractions.
        memory: bytes to reserve on those engines.
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
        digest: digest of the work done, if `ok`; equal work has equal digests.
        error: one line, if not `ok`.
        attempt: number of attempts, at least 1.
        node: host of the last attempt.
    """

    id: str
    ok: bool
    digest: str | None
    error: str | None
    attempt: int
    node: str


@dataclass(frozen=True)
class NodeReport:
    """What a unit told that ran on one of an engine's machines.

    Attributes:
        node: name and address of the machine.
        messages: the unit's messages, in order; all of them if there is no error.
        error: one line, if the unit did not end well there.
    """

    node: str
    messages: tuple[Mapping[str, Any], ...]
    error: str | None


class BaseEngine(abc.ABC):
    """Runs every unit at least once, in any order; a plug-in of the entry point group `tcmrl.engines`.

    Args:
        workers: maximum number of units that run at the same time; None for as many as fit.
        address: address of a cluster, for engines with `takes_address`.

    Raises:
        BuildError: an address is given, but the engine takes none.
    """

    name: ClassVar[str]
    takes_address: ClassVar[bool] = False
    """Whether the engine can use other machines, at an address."""

    def __init__(self, workers: int | None = None, *, address: str | None = None) -> None:
        if address is not None and not self.takes_address:
            raise BuildError(f"this engine takes no address, got {address!r}; leave it out or choose ray")
        self.workers, self.address = workers, address

    @abc.abstractmethod
    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        """Yields one result per unit as units end; closing the generator ends the running units.

        Raises:
            BuildError: a unit needs more resources than any machine has; no unit was started.
        """

    def run_on_every_node(self, unit: Unit) -> Sequence[NodeReport]:
        """Runs a unit once on every other machine that could run it, to compare the machines.

        An engine that uses this machine alone has none to compare.

        Args:
            unit: one that has a timeout; its resources choose the machines and are not reserved.

        Raises:
            BuildError: the machines cannot be reached.
        """
        return ()


ENGINES = Registry("tcmrl.engines", "engine", BaseEngine)


def make_engine(
    engine: str | BaseEngine, workers: int | None = None, address: str | None = None
) -> BaseEngine:
    """The engine of a name, with these arguments; an engine that is made already is used as it is."""
    return ENGINES.get(engine)(workers, address=address) if isinstance(engine, str) else engine


def longest_first(units: Sequence[Unit]) -> list[Unit]:
    """The units sorted by falling cost, so that short units fill the workers at the end."""
    return sorted(units, key=lambda unit: -unit.cost)
