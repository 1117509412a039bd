"""Making and publishing a part, whatever its episodes come from."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.records import as_model, canonical_json, digest
from tcmrl_data.parts.operation import Operation, Simulator, Sources, StoredPart, WantedPart
from tcmrl_data.recipe.recipe import same_settings
from tcmrl_data.store.archive import Archive, pack_archive
from tcmrl_data.store.arrays import array_digests, encode_arrays, pack
from tcmrl_data.store.part import (
    DATA_VERSION,
    PART_SCHEMA,
    RECORD,
    UNKNOWN,
    ArrayRecord,
    Identity,
    PartRecord,
    Platform,
    References,
    Statistics,
    check_members,
    read_part_record,
)
from tcmrl_data.store.part_table import PartEntry, part_entry
from tcmrl_data.store.tables import PartKey, part_file

NO_REFERENCES = References(uniform=None, oracle=None, scripted=None)
"""Where nobody has measured any."""

QUANTILES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)


def make_part(
    wanted: WantedPart,
    episodes: Sequence[Trajectory],
    *,
    references: References = NO_REFERENCES,
    behavior: Mapping[str, Any] | None = None,
    platform: Platform = UNKNOWN,
) -> tuple[PartRecord, bytes]:
    """The record and the archive of a part.

    Args:
        wanted: the part's identity but for its arrays.
        behavior: what the behavior source records with its parts.
    """
    arrays = pack(episodes)
    snapshot, derived = wanted.snapshot, wanted.derived
    identity = Identity(
        data_version=wanted.data_version,
        settings=dict(wanted.settings),
        task=wanted.task.index,
        parameters=dict(wanted.task.parameters),
        step=wanted.step,
        seed=wanted.seed,
        policy=None if snapshot is None else snapshot.digest(),
        arrays={name: as_model(ArrayRecord, record) for name, record in array_digests(arrays).items()},
        derived=None if derived is None else dict(derived),
    )
    record = PartRecord(
        schema_version=PART_SCHEMA,
        id=digest(identity.model_dump(mode="json")),
        identity=identity,
        statistics=statistics(episodes),
        references=references,
        behavior=dict(behavior or {}),
        platform=platform,
    )
    policy = {} if snapshot is None else snapshot.files()
    record_bytes = canonical_json(record.model_dump(mode="json"))
    return record, pack_archive(encode_arrays(arrays) | policy | {RECORD: record_bytes})


def statistics(trajectories: Sequence[Trajectory]) -> Statistics:
    """Return statistics and mergeable moments of a part."""
    returns = np.array([trajectory.undiscounted_return for trajectory in trajectories])
    success = [
        bool(np.any(trajectory.extras["success"]))
        for trajectory in trajectories
        if "success" in trajectory.extras
    ]
    moments = {}
    for name in ("observations", "actions"):
        rows = np.concatenate([getattr(trajectory, name) for trajectory in trajectories]).astype(np.float64)
        moments[name] = {
            "count": len(rows),
            "sum": rows.sum(axis=0).tolist(),
            "sum_of_squares": np.square(rows).sum(axis=0).tolist(),
        }
    return Statistics(
        episodes=len(trajectories),
        steps=sum(len(trajectory) for trajectory in trajectories),
        mean=float(returns.mean()),
        std=float(returns.std()),
        min=float(returns.min()),
        max=float(returns.max()),
        quantiles=tuple(float(quantile) for quantile in np.quantile(returns, QUANTILES)),
        success_rate=float(np.mean(success)) if success else None,
        moments=moments,
    )


def wanted_from(
    operation: Operation[Any], source: StoredPart, *, task: Task, simulator: Simulator | None = None
) -> WantedPart:
    """The identity of the part that an operation makes of a stored one.

    Args:
        simulator: of that task, for an operation that simulates: the new part goes by its recipe.
    """
    wanted = dataclasses.replace(source.wanted(), task=task, derived=operation.derived(source.record))
    if not operation.simulates:
        return wanted
    assert simulator is not None
    return dataclasses.replace(
        wanted, settings=simulator.recipe.unit_settings(), seed=simulator.seed, data_version=DATA_VERSION
    )


def make_from(
    operation: Operation[Any],
    source: StoredPart,
    *,
    task: Task,
    simulator: Simulator | None = None,
    references: References = NO_REFERENCES,
) -> tuple[PartRecord, bytes]:
    """The record and the archive of the part that an operation makes of a stored one.

    Args:
        references: of the task; parts that are not simulated keep those of the stored one.
    """
    wanted = wanted_from(operation, source, task=task, simulator=simulator)
    episodes = operation.make(wanted, Sources(simulator, (source,)))
    record = source.record
    if operation.simulates and simulator is not None:
        platform = simulator.platform
    else:
        references, platform = record.references, record.platform
    return make_part(wanted, episodes, references=references, behavior=record.behavior, platform=platform)


@dataclass(frozen=True)
class Published:
    """A published part, as a worker reports it to the driver or as it is found on disk.

    Attributes:
        entry: its line of the table, but for `platform`, which only the driver knows.
    """

    entry: PartEntry
    platform: Platform

    @classmethod
    def of_record(cls, record: PartRecord, *, run: str, archive: bytes) -> "Published":
        """The part with a record, published as `archive` in a run."""
        return cls(part_entry(record, run=run, platform=0, archive=archive), record.platform)

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> "Published":
        """The inverse of `to_message`."""
        platform = as_model(Platform, message["platform"])
        return cls(PartEntry(*message["entry"]), platform)

    def to_message(self) -> dict[str, Any]:
        """What a worker tells its driver."""
        platform = self.platform.model_dump(mode="json")
        return {"kind": "part", "entry": list(self.entry), "platform": platform}


def read_published(file: Path, run: str) -> tuple[Published, PartRecord]:
    """Reads a whole part that nobody has described yet, and its record."""
    with Archive(file) as archive:
        record = read_part_record(archive)
        check_members(archive, record)
        archive.check_form()
        return Published.of_record(record, run=run, archive=archive.content()), record


def publish(
    folder: Path,
    key: PartKey,
    make: Callable[[], tuple[PartRecord, bytes]],
    *,
    wanted: WantedPart | None = None,
) -> Published:
    """Publishes a part; a sound one that is there is left alone, and a damaged one made again.

    Args:
        wanted: what a part that is there must be; any will do where None.
    """
    file = folder / part_file(key)
    if file.exists():
        try:
            published, record = read_published(file, key.run)
        except (StoreError, ManifestError):
            pass
        else:
            if wanted is not None and not _is_wanted(record.identity, wanted):
                raise StoreError(f"{file}: holds another part; delete it or choose another --as")
            return published
    record, data = make()
    replace_file(file, data, staging=folder / STAGING)
    return Published.of_record(record, run=key.run, archive=data)


def _is_wanted(identity: Identity, wanted: WantedPart) -> bool:
    policy = None if wanted.snapshot is None else wanted.snapshot.digest()
    found = (identity.derived, identity.policy, identity.seed, identity.parameters)
    asked = (wanted.derived, policy, wanted.seed, wanted.task.parameters)
    return found == asked and same_settings(identity.settings, wanted.settings)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread: digests depend on it, since reductions split by thread round differently."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def numbered(parts: Iterable[Published], platforms: list[Platform]) -> list[PartEntry]:
    """The parts' lines with the positions of their platforms; adds new platforms to the list."""
    entries = []
    for part in parts:
        if part.platform not in platforms:
            platforms.append(part.platform)
        entries.append(part.entry._replace(platform=platforms.index(part.platform)))
    return entries
