"""Why a part differs from another: the first cause along the pipeline that makes parts."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.part_record import STANDARD_ARRAYS, Identity

Stage = Literal["data version", "settings", "seed", "parameters", "derivation", "policy", "arrays"]


@dataclass(frozen=True)
class Cause:
    """The first cause of a difference.

    Attributes:
        key: the part's.
        stage: the first stage of the pipeline that differs; later ones follow from it.
        detail: what differs in it.
        platform: how the left part's platform (here) differs from the right one's (there).
    """

    key: PartKey
    stage: Stage
    detail: str
    platform: tuple[str, ...]


def first_cause(left: Dataset, right: Dataset, key: PartKey, *, decode: bool) -> Cause:
    """Why the parts of a key differ.

    Args:
        left: a dataset.
        right: another one.
        key: of a part that both have, with different ids.
        decode: also read policies and arrays, to name the first tensor, or the first step.

    Raises:
        StoreError: a part is damaged.
    """
    one, other = left.part(*key), right.part(*key)
    first, second = one.identity, other.identity
    platform = tuple(one.platform.differences(other.platform))
    for stage, found in _fields(first, second):
        return Cause(key, stage, found, platform)
    if first.policy != second.policy:
        detail = "the snapshots have different digests"
        if decode and first.policy is not None and second.policy is not None:
            detail = _policy_difference(left, right, key)
        return Cause(key, "policy", detail, platform)
    names = [
        name for name in {*first.arrays, *second.arrays} if first.arrays.get(name) != second.arrays.get(name)
    ]
    detail = f"{', '.join(sorted(names, key=_order))} differ"
    if decode:
        detail = _array_difference(left.arrays(*key), right.arrays(*key)) or detail
    return Cause(key, "arrays", detail, platform)


def _fields(first: Identity, second: Identity) -> Iterator[tuple[Stage, str]]:
    """The stages before the policy that differ, with the first value that does."""
    stages: tuple[tuple[Stage, Any, Any], ...] = (
        ("data version", first.data_version, second.data_version),
        ("settings", first.settings, second.settings),
        ("seed", first.seed, second.seed),
        ("parameters", first.parameters, second.parameters),
        ("derivation", first.derived, second.derived),
    )
    for stage, left, right in stages:
        if left != right:
            yield stage, _value_difference(left, right)


def _value_difference(left: Any, right: Any, place: str = "") -> str:
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        for name in sorted({*left, *right}):
            if left.get(name) != right.get(name):
                return _value_difference(
                    left.get(name), right.get(name), f"{place}.{name}" if place else name
                )
    return f"{place} {_short(left)} → {_short(right)}".strip()


def _short(value: Any) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _policy_difference(left: Dataset, right: Dataset, key: PartKey) -> str:
    first, second = left.snapshot(*key), right.snapshot(*key)
    if first.description != second.description:
        return _value_difference(first.description.model_dump(), second.description.model_dump())
    for name, tensor in first.tensors.items():
        if tensor.tobytes() != second.tensors[name].tobytes():
            gap = float(np.abs(tensor - second.tensors[name]).max())
            return f"weights differ, first {name} by up to {gap:.3g}"
    return "the snapshots have different digests"


def _order(name: str) -> tuple[int, str]:
    standard = list(STANDARD_ARRAYS)
    return (standard.index(name) if name in standard else len(standard), name)


def _array_difference(
    left: Mapping[str, npt.NDArray[Any]], right: Mapping[str, npt.NDArray[Any]]
) -> str | None:
    """The first step in which arrays differ, in words."""
    lengths = [np.diff(side["episode_offsets"]) for side in (left, right)]
    if len(lengths[0]) != len(lengths[1]):
        return f"{len(lengths[0])} episodes → {len(lengths[1])}"
    found: list[tuple[int, int, tuple[int, str]]] = []
    for name in sorted({*left, *right} - {"episode_offsets"}, key=_order):
        if name not in left or name not in right:
            return f"{name} is on one side only"
        for episode in range(len(lengths[0])):
            one, other = (_episode(side, name, episode) for side in (left, right))
            step = _first_row(one, other)
            if step is not None:
                found.append((episode, step, _order(name)))
                break
    if not found:
        return None
    episode, step, (_, name) = min(found)
    return f"{name} differ from episode {episode}, step {step} on"


def _episode(arrays: Mapping[str, npt.NDArray[Any]], name: str, episode: int) -> npt.NDArray[Any]:
    """The rows of an episode; observations have one row more per episode."""
    start, stop = (int(offset) for offset in arrays["episode_offsets"][episode : episode + 2])
    shift = episode if name == "observations" else 0
    return arrays[name][start + shift : stop + shift + (name == "observations")]


def _first_row(left: npt.NDArray[Any], right: npt.NDArray[Any]) -> int | None:
    """The first row in which two arrays differ; the length of the shorter one where that is all."""
    if left.shape[1:] != right.shape[1:]:
        return 0
    rows = min(len(left), len(right))
    unequal = (left[:rows] != right[:rows]).reshape(rows, -1).any(axis=1)
    if unequal.any():
        return int(unequal.argmax())
    return None if len(left) == len(right) else rows
