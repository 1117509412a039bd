"""Further episodes of stored policies: what a part records of them, and how they are made."""

from typing import Any

from pydantic import Field

from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.building.part import roll_out_part
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.envs.base import Lanes
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.records import Record
from tcmrl_data.store.limits import MAX_INDEX

EXTEND = "extend"
"""The operation's name in records."""

MAX_NOISE = 10.0


class Extension(Record):
    """Settings of an extended part.

    Attributes:
        task: the task that the policy was made for.
        parameters: of that task; scripted policies act by them.
        first_episode: number of the part's first episode among those of its keyed seeds.
        noise: standard deviation of normal noise that was added to actions.
    """

    task: int = Field(ge=0, lt=MAX_INDEX)
    parameters: dict[str, Any]
    first_episode: int = Field(ge=0, lt=MAX_INDEX)
    noise: float = Field(ge=0, le=MAX_NOISE)


def extended_episodes(
    plan: BuildPlan, snapshot: Snapshot, extension: Extension, lanes: Lanes
) -> list[Trajectory]:
    """The episodes of an extended part.

    Args:
        plan: of one task, in which the policy acts; its recipe says how many episodes.
        snapshot: the policy.
        extension: the settings.
        lanes: of the task.
    """
    (task,) = plan.tasks
    return roll_out_part(
        plan,
        task=task,
        snapshot=snapshot,
        lanes=lanes,
        policy_parameters=extension.parameters,
        first_episode=extension.first_episode,
        noise=extension.noise,
    )
