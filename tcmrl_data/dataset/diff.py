"""Differences of two datasets, down to the cause of the first one along the pipeline that makes parts."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import differences, leaves
from tcmrl_data.remote.address import Address
from tcmrl_data.store.part import STANDARD_ARRAYS, Identity
from tcmrl_data.store.tables import PartKey

Stage = Literal["data version", "settings", "seed", "parameters", "derivation", "policy", "arrays"]


@dataclass(frozen=True)
class Cause:
    """The first cause of a difference.

    Attributes:
        stage: the first stage of the pipeline that differs; later ones follow from it.
        platform: how the left part's platform (here) differs from the right one's (there).
    """

    key: PartKey
    stage: Stage
    detail: str
    platform: tuple[str, ...]


def first_cause(left: Dataset, right: Dataset, key: PartKey, *, decode: bool) -> Cause:
    """Why the parts of a key differ.

    Args:
        key: of a part that both have, with different ids.
        decode: also read policies and arrays, to name the first tensor, or the first step.
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


def _value_difference(left: Any, right: Any) -> str:
    place, one, other = next(differences(left, right))
    return f"{place} {_short(one)} → {_short(other)}".strip()


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


DiffLevel = Literal["manifest", "statistics", "arrays"]
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Change:
    """A value that differs; None where a side does not have it."""

    name: str
    left: Any
    right: Any


@dataclass(frozen=True)
class ReturnsDiff:
    """Mean returns of last snapshots over tasks.

    Attributes:
        left: mean over the tasks of the left dataset.
        right: mean over the tasks of the right one.
        low: lower end of Welch's 95% interval of the difference; None with fewer than two tasks in a dataset.
    """

    left: float
    right: float
    difference: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class ObservationsDiff:
    """The observation column whose mean differs most.

    Attributes:
        left: its mean over all steps of the left dataset.
        shift: right minus left in standard deviations of the left dataset; None where these are zero.
    """

    column: int
    left: float
    right: float
    shift: float | None


@dataclass(frozen=True)
class DatasetDiff:
    """What differs between two datasets.

    Attributes:
        recipe: keys of the recipes that differ; their training defaults do not count.
        platforms: names of packages and of parts of platforms, with all values of each side.
        tasks: tasks that one side lacks, or that have another split or other parameters.
        equal: number of parts that both have.
        returns: None where they are equal.
        observations: None where they are equal, or were not compared.
        first: why the first part that differs does; None if there is none, or it was not looked for.
    """

    left: Path | Address
    right: Path | Address
    roots: tuple[str, str]
    recipe: tuple[Change, ...]
    runs: tuple[Change, ...]
    platforms: tuple[Change, ...]
    tasks: tuple[Change, ...]
    equal: int
    different: tuple[PartKey, ...]
    left_only: tuple[PartKey, ...]
    right_only: tuple[PartKey, ...]
    returns: ReturnsDiff | None
    observations: ObservationsDiff | None
    first: Cause | None

    @property
    def same_root(self) -> bool:
        """Whether both hold the same parts."""
        return self.roots[0] == self.roots[1]

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs at all; datasets of equal roots may differ in splits or platforms."""
        return self.same_root and not (self.recipe or self.runs or self.platforms or self.tasks)


def diff_datasets(
    left: str | Path | Dataset, right: str | Path | Dataset, *, level: DiffLevel = "statistics"
) -> DatasetDiff:
    """Compares two datasets and names the cause of the first difference.

    Args:
        right: another one, of the same environment or not.
        level: `manifest` reads manifests and tables; `statistics` also the records of parts, with the moments
            of observations; `arrays` also decodes the first part that differs, to find its first row.

    Raises:
        ManifestError: one of them cannot be read.
        StoreError: a part that is compared is damaged.

    Example:
        >>> found = diff_datasets("data/point-robot", "data/point-robot")  # doctest: +SKIP
        >>> found.is_empty  # doctest: +SKIP
        True
    """
    if level not in ("manifest", "statistics", "arrays"):
        raise SelectionError(f"level {level!r}: expected manifest, statistics or arrays")
    first, second = (side if isinstance(side, Dataset) else open_dataset(side) for side in (left, right))
    ids = [{entry.key: entry.id for entry in side.parts.entries()} for side in (first, second)]
    both = sorted(ids[0].keys() & ids[1].keys())
    different = tuple(key for key in both if ids[0][key] != ids[1][key])
    same = first.manifest.root == second.manifest.root
    reads_parts = level != "manifest" and not same
    return DatasetDiff(
        left=first.path,
        right=second.path,
        roots=(first.manifest.root, second.manifest.root),
        recipe=tuple(_changes(_recipe(first), _recipe(second))),
        runs=tuple(_changes(*map(_runs, (first, second)))),
        platforms=tuple(_changes(*map(_platforms, (first, second)))),
        tasks=tuple(_changes(*map(_tasks, (first, second)))),
        equal=len(both) - len(different),
        different=different,
        left_only=tuple(sorted(ids[0].keys() - ids[1].keys())),
        right_only=tuple(sorted(ids[1].keys() - ids[0].keys())),
        returns=None if same else _returns(first, second),
        observations=_observations(first, second) if reads_parts else None,
        first=first_cause(first, second, different[0], decode=level == "arrays")
        if different and reads_parts
        else None,
    )


def why_not_published(built: str | Path | Dataset, published: str | Dataset) -> str | None:
    """Why a dataset does not have a published root, in one line; None if it does.

    Args:
        built: a dataset.
        published: a root, of at least 12 digits, or the dataset that it should be equal to: this one's parts
            then tell the first that differs and why, the platform first.

    Raises:
        ManifestError: the built dataset cannot be read.
    """
    dataset = built if isinstance(built, Dataset) else open_dataset(built)
    root = dataset.manifest.root
    expected = published if isinstance(published, str) else published.manifest.root
    if root.startswith(expected):
        return None
    words = f"{dataset.path} has root {root[:12]}, and {expected[:12]} was published"
    if isinstance(published, str):
        copy = "`tcmrl-data diff` with a copy of it says why"
        return f"{words}; {copy}"
    found = diff_datasets(published, dataset)
    if found.first is not None:
        platform = f"made on another platform ({'; '.join(found.first.platform)}), " * bool(
            found.first.platform
        )
        return f"{words}; the first part that differs is {found.first.key}: {platform}{found.first.detail}"
    for what, keys in (("lacks", found.left_only), ("has besides", found.right_only)):
        if keys:
            return f"{words}; it {what} {len(keys)} parts, first {keys[0]}"
    return words


def _recipe(dataset: Dataset) -> dict[str, Any]:
    recipe = dataset.manifest.recipe.unit_settings()
    return _flat({**recipe, "profile": dataset.manifest.profile})


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    return {".".join(map(str, path)): value for path, value in leaves(values)}


def _runs(dataset: Dataset) -> dict[str, Any]:
    fields = ("kind", "seed", "origin", "steps")
    return {
        f"{run.name}.{name}": value
        for run in dataset.manifest.runs
        for name, value in run.model_dump(mode="json", include=set(fields)).items()
        if value is not None
    }


def _platforms(dataset: Dataset) -> dict[str, Any]:
    found: dict[str, set[str]] = {}
    for platform in dataset.manifest.platforms:
        values = platform.model_dump(mode="json", exclude={"packages"}) | platform.packages
        for name, value in _flat(values).items():
            found.setdefault(name, set()).add(str(value))
    return {name: sorted(values) for name, values in found.items()}


def _tasks(dataset: Dataset) -> dict[str, Any]:
    return {
        f"task {task.index}": {"split": task.split, "parameters": dict(task.parameters)}
        for task in dataset.tasks
    }


def _changes(left: Mapping[str, Any], right: Mapping[str, Any]) -> Iterator[Change]:
    """The names whose values differ; first those of the left side, in its order."""
    for name in [*left, *(name for name in right if name not in left)]:
        if left.get(name) != right.get(name):
            yield Change(name, left.get(name), right.get(name))


def _returns(left: Dataset, right: Dataset) -> ReturnsDiff | None:
    """The returns of the last snapshots of the first runs, with Welch's interval over tasks."""
    samples = [np.array(_last_means(side)) for side in (left, right)]
    if not all(map(len, samples)):
        return None
    means = [float(sample.mean()) for sample in samples]
    gap = means[1] - means[0]
    low = high = None
    if min(map(len, samples)) > 1:
        half = _welch_half_width(samples)
        low, high = gap - half, gap + half
    return (
        ReturnsDiff(means[0], means[1], gap, low, high)
        if gap or not np.array_equal(samples[0], samples[1])
        else None
    )


def _welch_half_width(samples: Sequence[npt.NDArray[np.float64]]) -> float:
    """Half the width of Welch's interval of the difference of two means; 0 without any variance.

    SciPy's own warns where the values of a sample are nearly identical.
    """
    from scipy import stats

    squares = np.array([sample.var(ddof=1) / len(sample) for sample in samples])
    error = math.sqrt(squares.sum())
    if not error:
        return 0.0
    shares = squares / squares.sum()
    freedom = 1.0 / sum(share**2 / (len(sample) - 1) for share, sample in zip(shares, samples, strict=True))
    return float(stats.t.ppf((1.0 + CONFIDENCE) / 2.0, freedom)) * error


def _last_means(dataset: Dataset) -> list[float]:
    """Mean return of the last snapshot of every task that has one in the first run."""
    run = dataset.manifest.runs[0].name
    last = {entry.task: entry.mean for entry in dataset.parts.entries() if entry.run == run}
    return list(last.values())  # entries are sorted by step


def _observations(left: Dataset, right: Dataset) -> ObservationsDiff | None:
    found = [_moments(side) for side in (left, right)]
    if found[0][0].shape != found[1][0].shape:
        return None
    (mean, spread), (other, _) = found
    gaps = other - mean
    if not gaps.any():
        return None
    shifts = np.divide(gaps, spread, out=np.zeros_like(gaps), where=spread > 0)
    column = int(np.abs(shifts).argmax()) if shifts.any() else int(np.abs(gaps).argmax())
    shift = float(shifts[column]) if spread[column] > 0 else None
    return ObservationsDiff(column, float(mean[column]), float(other[column]), shift)


def _moments(dataset: Dataset) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Mean and standard deviation of every observation column, from the moments of all parts."""
    found = [dataset.part(*key).statistics.moments["observations"] for key in dataset.parts]
    count = sum(moments["count"] for moments in found)
    mean = _total(moments["sum"] for moments in found) / count
    square = _total(moments["sum_of_squares"] for moments in found) / count
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0))


def _total(rows: Iterable[Sequence[float]]) -> npt.NDArray[np.float64]:
    return np.array([math.fsum(column) for column in zip(*rows, strict=True)])
