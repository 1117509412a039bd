"""Fewer episodes: every n-th of each part, spread over all that the policy was rolled out for."""

from collections.abc import Mapping
from typing import Any, ClassVar, final

from pydantic import Field

from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.records import Record
from tcmrl_data.parts.operation import Operation, Sources, WantedPart


class EveryNthSettings(Record):
    """Which episodes are kept."""

    n: int = Field(ge=1)


@final
class EveryNth(Operation[EveryNthSettings]):
    """The episodes 0, n, 2n, … of a stored part."""

    name = "every-nth"
    Settings = EveryNthSettings
    example: ClassVar[Mapping[str, Any]] = {"n": 2}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        return sources.part.episodes()[:: self.settings.n]
