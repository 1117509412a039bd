"""What a protocol is: how test tasks are adapted to before the final episodes."""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from tcmrl_algo.adaptation.arena import Arena, Context
from tcmrl_algo.settings.run import PROTOCOL_GROUP
from tcmrl_data import Task
from tcmrl_data.foundation.plugins import Registry


@dataclass(frozen=True)
class Adaptation:
    """How one test task was adapted to.

    Attributes:
        returns: undiscounted return of each adaptation episode.
        contexts: what the final policy is adapted by; several where the protocol draws several, and never
            none. A context without trajectories stands for the prior.
    """

    returns: list[float]
    contexts: list[Context]


class Protocol(abc.ABC):
    """Adapts to test tasks: a plug-in, stateless, and made without arguments.

    A package declares it as an entry point of the group `tcmrl.protocols`, under `name`.

    Attributes:
        name: as `--protocol`, `run.protocol` and the `protocols` of an experiment spell it.

    Example:
        >>> PROTOCOLS.get("offline").name
        'offline'
    """

    name: ClassVar[str]

    @abc.abstractmethod
    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
        """One adaptation per task, each of `arena.settings.episodes` episodes.

        Args:
            arena: runs episodes, and holds stored trajectories.
            tasks: the test tasks.
        """


PROTOCOLS = Registry(PROTOCOL_GROUP, "protocol", Protocol)
