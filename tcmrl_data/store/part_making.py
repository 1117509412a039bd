"""The record and the archive of a new part, whatever its episodes came from."""

from collections.abc import Mapping, Sequence
from typing import Any

from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import canonical_json, digest
from tcmrl_data.store.archive import pack_archive
from tcmrl_data.store.arrays import array_digests, encode_arrays, pack
from tcmrl_data.store.part_record import (
    DATA_VERSION,
    PART_SCHEMA,
    RECORD,
    ArrayRecord,
    Identity,
    PartRecord,
    References,
)
from tcmrl_data.store.platform import UNKNOWN, Platform
from tcmrl_data.store.statistics import statistics

NO_REFERENCES = References(uniform=None, oracle=None, scripted=None)
"""Where nobody has measured any."""


def make_part(
    *,
    settings: Mapping[str, Any],
    task: Task,
    step: int,
    seed: int | None,
    snapshot: Snapshot | None,
    trajectories: Sequence[Trajectory],
    references: References = NO_REFERENCES,
    behavior: Mapping[str, Any] | None = None,
    platform: Platform = UNKNOWN,
    derived: Mapping[str, Any] | None = None,
    data_version: int = DATA_VERSION,
) -> tuple[PartRecord, bytes]:
    """The record and the archive of a part.

    Args:
        settings: the unit settings of the run's recipe.
        task: the part's.
        step: snapshot step.
        seed: root seed of the run; None where it is not known.
        snapshot: the policy; None where it is not known.
        trajectories: the episodes, at least one.
        references: of the task.
        behavior: what the behavior source records with its parts.
        platform: on which the episodes were made.
        derived: how the part was made from others: `operation`, `from` (ids of parts) and `settings`.
        data_version: of the code that made the episodes.
    """
    arrays = pack(trajectories)
    identity = Identity(
        data_version=data_version,
        settings=dict(settings),
        task=task.index,
        parameters=dict(task.parameters),
        step=step,
        seed=seed,
        policy=None if snapshot is None else snapshot.digest(),
        arrays={
            name: ArrayRecord.model_validate_json(canonical_json(record))
            for name, record in array_digests(arrays).items()
        },
        derived=None if derived is None else dict(derived),
    )
    record = PartRecord(
        schema_version=PART_SCHEMA,
        id=digest(identity.model_dump(mode="json")),
        identity=identity,
        statistics=statistics(trajectories),
        references=references,
        behavior=dict(behavior or {}),
        platform=platform,
    )
    policy = {} if snapshot is None else snapshot.files()
    record_bytes = canonical_json(record.model_dump(mode="json"))
    return record, pack_archive(encode_arrays(arrays) | policy | {RECORD: record_bytes})
