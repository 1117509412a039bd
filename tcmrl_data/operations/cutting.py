"""Parts made of others by leaving out episodes or extra arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import count_ranges, read_ranges, write_ranges
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import read_arrays, unpack
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.limits import MAX_COUNT
from tcmrl_data.store.part_making import make_part
from tcmrl_data.store.part_record import STANDARD_ARRAYS, Identity, PartRecord

SUBSET = "subset"
"""Operation of parts that lack episodes or arrays of another, and of datasets that lack parts."""


@dataclass(frozen=True)
class Cut:
    """What is kept of a part.

    Attributes:
        episodes: positions of the episodes, ascending; None keeps all.
        without: extra arrays that are left out.
    """

    episodes: tuple[int, ...] | None = None
    without: tuple[str, ...] = ()


def cut_part(source: Dataset, key: PartKey, cut: Cut) -> tuple[PartRecord, bytes]:
    """The record and the archive of a part without some episodes or arrays.

    A cut of a cut part is recorded as one cut of the first part, so that equal contents have equal ids.

    Args:
        source: the dataset.
        key: the part in it.
        cut: what is kept.

    Raises:
        StoreError: the part is damaged.
        SelectionError: it has no such array, or no such episode.
    """
    record = source.part(*key)
    identity = record.identity
    source.content(key)  # compares the sha256: what is damaged must not become a sound part
    with source.open_part(key) as archive:
        trajectories = cut_episodes(archive, record, cut)
    return make_part(
        settings=identity.settings,
        task=source.task(key.task),
        step=key.step,
        seed=identity.seed,
        snapshot=None if identity.policy is None else source.snapshot(*key),
        trajectories=trajectories,
        references=record.references,
        behavior=record.behavior,
        platform=record.platform,
        derived=_derived(record, cut),
        data_version=identity.data_version,
    )


def cut_episodes(archive: Archive, record: PartRecord, cut: Cut) -> list[Trajectory]:
    """The episodes of a part that a cut keeps, without the arrays that it leaves out.

    Raises:
        StoreError: the arrays cannot be decoded.
        SelectionError: no such array, or no such episode.
    """
    names = list(record.identity.arrays)
    for name in cut.without:
        if name in STANDARD_ARRAYS or name not in names:
            extras = ", ".join(sorted(set(names) - set(STANDARD_ARRAYS))) or "none"
            raise SelectionError(
                f"{archive.path}: {name!r} cannot be left out; its extra arrays are: {extras}"
            )
    trajectories = unpack(read_arrays(archive, [name for name in names if name not in cut.without]))
    positions = range(len(trajectories)) if cut.episodes is None else cut.episodes
    if not positions or positions[-1] >= len(trajectories):
        raise SelectionError(f"{archive.path} has {len(trajectories)} episodes; keep some of them")
    return [trajectories[position] for position in positions]


def read_cut(identity: Identity) -> tuple[str, Cut]:
    """The id of the part that a part was cut from, and the cut.

    Raises:
        ValueError: its `derived` does not describe a cut that leaves as many episodes as there are.
    """
    derived = identity.derived or {}
    origin, settings = derived.get("from"), derived.get("settings")
    if derived.get("operation") != SUBSET or not isinstance(settings, dict):
        raise ValueError("is no cut")
    if not (isinstance(origin, list) and len(origin) == 1 and isinstance(origin[0], str)):
        raise ValueError("does not name the one part that it was cut from")
    episodes, without = settings.get("episodes"), settings.get("without")
    if not isinstance(episodes, str | None) or not isinstance(without, list):
        raise ValueError("does not say which episodes and arrays were kept")
    if set(map(str, without)) & set(identity.arrays):
        raise ValueError("names an array that is there")
    number = identity.arrays["episode_offsets"].shape[0] - 1
    if episodes is not None and count_ranges(episodes, limit=MAX_COUNT) != number:
        raise ValueError(f"does not name {number} episodes")
    positions = None if episodes is None else tuple(read_ranges(episodes, limit=MAX_COUNT))
    return origin[0], Cut(positions, tuple(map(str, without)))


def _derived(record: PartRecord, cut: Cut) -> dict[str, Any]:
    """The `derived` of the cut part."""
    origin, episodes, without = record.id, cut.episodes, cut.without
    before = record.identity.derived
    if before is not None and before.get("operation") == SUBSET:
        origin, earlier = read_cut(record.identity)
        episodes, without = _composed(earlier.episodes, episodes), (*earlier.without, *without)
    kept = None if episodes is None else write_ranges(episodes)
    settings = {"episodes": kept, "without": sorted(without)}
    return {"operation": SUBSET, "from": [origin], "settings": settings}


def _composed(first: Sequence[int] | None, then: Sequence[int] | None) -> tuple[int, ...] | None:
    """The positions that are left of all episodes when the second choice is made among the first."""
    if first is None or then is None:
        return tuple(first) if first is not None else None if then is None else tuple(then)
    return tuple(first[position] for position in then)
