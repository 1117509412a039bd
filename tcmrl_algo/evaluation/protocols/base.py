"""The interface of protocols, which adapt a policy to test tasks before the final episodes."""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from tcmrl_algo.algorithms.core.settings import PROTOCOL_GROUP
from tcmrl_algo.evaluation.arena import Arena, Context
from tcmrl_data import Task
from tcmrl_data.foundation.plugins import Registry


@dataclass(frozen=True)
class Adaptation:
    """Result of the adaptation to one test task.

    Attributes:
        returns: undiscounted returns of the adaptation episodes.
        contexts: contexts of the final policy, one or more, as the protocol draws them. An empty context is
            the prior.
    """

    returns: list[float]
    contexts: list[Context]


class Protocol(abc.ABC):
    """Adapts to test tasks. A protocol is a plug-in without state, created without arguments.

    A package declares a protocol as an entry point of the group `tcmrl.protocols` with the name `name`.
    Every method gets the same numbers of episodes under a protocol, those of the environment's recipe; a
    method cannot ask for more.

    Attributes:
        name: the value of `--protocol`, of `run.protocol` and in `protocols` of an experiment.
        split: the tasks that are evaluated: the test tasks, or as many training tasks, evenly spread.
        repeated: whether the first stage is random, so that evaluation adapts `run.repeats` times to every
            task and averages.

    Example:
        >>> PROTOCOLS.get("offline").name
        'offline'
    """

    name: ClassVar[str]
    split: ClassVar[Literal["train", "test"]] = "test"
    repeated: ClassVar[bool] = False

    @abc.abstractmethod
    def adapt(self, arena: Arena, tasks: Sequence[Task]) -> list[Adaptation]:
        """Adapts to every task with `arena.settings.episodes` episodes; returns one adaptation per entry.

        Args:
            arena: runs episodes and draws stored trajectories.
            tasks: those to adapt to; of a repeated protocol every task `run.repeats` times, as lanes whose
                random draws are independent.
        """


PROTOCOLS = Registry(PROTOCOL_GROUP, "protocol", Protocol)
