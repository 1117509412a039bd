"""Which datasets lie below a folder; what a dataset holds, as JSON documents; how far its test tasks lie.

Returns are undiscounted sums of the stored rewards.
"""

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.dataset.selection import is_view_file
from tcmrl_data.envs.base import Split, Task, place_in_order
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import STAGING
from tcmrl_data.foundation.errors import ManifestError, RemoteError, SelectionError, TcmrlError
from tcmrl_data.foundation.files import read_plain_file
from tcmrl_data.foundation.records import MAX_JSON_BYTES
from tcmrl_data.remote.address import Address, is_url, parse_address
from tcmrl_data.remote.published import find_datasets
from tcmrl_data.store.manifest import EPISODES, FOLD, MANIFEST, Derivation
from tcmrl_data.store.tables import PARTS


def list_datasets(root: str | Path) -> list[dict[str, Any]]:
    """A `dataset_row` for every dataset and view below a folder or address.

    Unreadable ones have `path` and `error`. Every tag of an address has a row of its own.

    Raises:
        RemoteError: the server of an address does not answer, or lists nothing.
    """
    rows: list[dict[str, Any]] = []
    found: Iterable[Path | Address] = (
        find_datasets(parse_address(root)) if is_url(root) else sorted(_paths(Path(root)))
    )
    for path in found:
        try:
            rows.append(dataset_row(open_dataset(path)))
        except (ManifestError, RemoteError) as error:
            rows.append({"path": str(path), "error": str(error)})
    return rows


def _paths(root: Path) -> Iterator[Path]:
    for folder, inner, files in os.walk(root):
        is_dataset = MANIFEST in files
        if is_dataset:
            yield Path(folder)
        else:
            yield from (Path(folder, name) for name in files if _is_view(Path(folder, name)))
        # in staging are parts on their way, such as those that a repair makes again; archives are many
        inner[:] = [name for name in inner if name != STAGING and not (is_dataset and name == PARTS)]


def _is_view(file: Path) -> bool:
    try:
        return is_view_file(file) and b'"source_root"' in read_plain_file(file, limit=MAX_JSON_BYTES)
    except (OSError, ValueError):
        return False


def dataset_row(dataset: Dataset) -> dict[str, Any]:
    """What a dataset's manifest says in short; `source` is the folder that a view reads."""
    manifest = dataset.manifest
    return {
        "path": str(dataset.path),
        "label": manifest.label,
        "name": manifest.name,
        "profile": manifest.profile,
        "behavior": manifest.recipe.behavior.source,
        "seed": manifest.seed,
        "derived": _derived(manifest.derivation),
        "source": None if dataset.remote or dataset.path == dataset.folder else str(dataset.folder),
        "tasks": manifest.num_tasks,
        "parts": manifest.totals.parts,
        "complete": manifest.complete,
        "root": manifest.root,
    }


def _derived(derivation: Derivation | None) -> str | None:
    if derivation is None:
        return None
    settings = derivation.settings
    if derivation.operation == FOLD:
        return f"fold {settings['fold']} of {settings['folds']}"
    if derivation.operation == EPISODES:
        first, number = settings["first"], settings["number"]
        return f"episodes {first}-{first + number - 1}"
    return derivation.operation


def dataset_summary(dataset: Dataset) -> dict[str, Any]:
    """What a dataset is, how large it is, and on what it was made.

    Returns:
        The row of `list_datasets`, and: `description`; `train` and `test` tasks; steps of `snapshots`;
        `parts_total`, parts when complete; `episodes`, `steps`, `bytes`, of what is there; and under
        `made_with` all values of `packages`, `python`, `cpu`, `system` of the platforms.
    """
    manifest = dataset.manifest
    platforms = manifest.platforms
    return dataset_row(dataset) | {
        "description": manifest.recipe.about.description,
        "train": len(dataset.train_tasks),
        "test": len(dataset.test_tasks),
        "snapshots": sorted(set(dataset.parts.columns["step"].tolist()) | {*(manifest.steps or ())}),
        "parts_total": manifest.num_expected,
        "episodes": manifest.totals.episodes,
        "steps": manifest.totals.steps,
        "bytes": manifest.totals.bytes,
        "made_with": {
            "packages": _distinct(_versions(platform.packages) for platform in platforms),
            "python": _distinct(platform.python for platform in platforms),
            "cpu": _distinct(platform.cpu for platform in platforms),
            "system": _distinct(platform.system for platform in platforms),
        },
    }


def _versions(packages: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in sorted(packages.items()))


def _distinct(values: Iterable[str]) -> list[str]:
    return sorted(set(values))


SPLITS: tuple[Split, ...] = ("train", "test")
RETURN_FIELDS = ("episodes", "steps", "mean", "std", "min", "max", "success_rate")


def list_returns(dataset: Dataset) -> dict[str, Any]:
    """Returns per task and snapshot, the document of `tcmrl-data inspect returns --json`.

    Args:
        dataset: the dataset; of an incomplete one, what is there.

    Returns:
        `{"name", "environment", "tasks": [{"task", "split", "snapshots": [{"step", "run", "episodes",
        "steps", "mean", "std", "min", "max", "success_rate"}]}]}`; mean to max are over a snapshot's
        episodes, std is the population's, success_rate is null without a success signal.

    Example:
        >>> import tcmrl_data
        >>> dataset = tcmrl_data.open_dataset("data/point-robot")  # doctest: +SKIP
        >>> tcmrl_data.list_returns(dataset)["tasks"][0]["split"]  # doctest: +SKIP
        'train'
    """
    return _heading(dataset) | {
        "tasks": [
            {
                "task": task.index,
                "split": task.split,
                "snapshots": [
                    {name: getattr(entry, name) for name in ("step", "run", *RETURN_FIELDS)}
                    for entry in dataset.parts.entries_of(task.index)
                ],
            }
            for task in dataset.tasks
        ]
    }


def list_tasks(dataset: Dataset) -> dict[str, Any]:
    """Parameters and reference returns of every task, and how far test tasks lie from training tasks.

    References are null while a task is incomplete; `shift` is explained by `ParameterShift`.
    """
    return _heading(dataset) | {
        "shift": shift_rows(dataset),
        "tasks": [
            {
                "task": task.index,
                "split": task.split,
                "parameters": dict(task.parameters),
                "references": None
                if dataset.missing(task.index)
                else dataset.references(task.index).model_dump(),
            }
            for task in dataset.tasks
        ],
    }


def list_snapshots(dataset: Dataset) -> dict[str, Any]:
    """Every part: task, split, step, run, id, episodes, steps and mean return."""
    rows = [
        {"task": task.index, "split": task.split}
        | {name: getattr(entry, name) for name in ("step", "run", "id", "episodes", "steps", "mean")}
        for task in dataset.tasks
        for entry in dataset.parts.entries_of(task.index)
    ]
    return _heading(dataset) | {"snapshots": rows}


def list_episodes(dataset: Dataset, *, task: int | None = None, step: int | None = None) -> dict[str, Any]:
    """Every episode: length, return, how it ended, and whether it succeeded at any step."""
    tasks = dataset.tasks if task is None else (dataset.task(task),)
    keys = [
        key for one in tasks for key in dataset.parts.keys_of(one.index) if step is None or key.step == step
    ]
    if not keys:
        steps = sorted({key.step for one in tasks for key in dataset.parts.keys_of(one.index)})
        raise SelectionError(f"{dataset.path} has no snapshot of step {step}; its steps are {steps}")
    rows = [
        {"task": key.task, "step": key.step, "run": key.run, "episode": episode} | _episode(trajectory)
        for key in keys
        for episode, trajectory in enumerate(dataset.trajectories(*key))
    ]
    return _heading(dataset) | {"episodes": rows}


def summarize_returns(table: dict[str, Any]) -> list[dict[str, Any]]:
    """One row per snapshot step and split: mean, std, min, max over the tasks' mean returns."""
    steps = sorted({found["step"] for task in table["tasks"] for found in task["snapshots"]})
    rows = []
    for step in steps:
        for split in SPLITS:
            found = list(_at(table, step, split))
            if not found:
                continue
            means = np.array([row["mean"] for row in found])
            success = [row["success_rate"] for row in found if row["success_rate"] is not None]
            rows.append(
                {
                    "step": step,
                    "split": split,
                    "tasks": len(found),
                    "episodes": sum(row["episodes"] for row in found),
                    "mean": float(means.mean()),
                    "std": float(means.std()),
                    "min": float(means.min()),
                    "max": float(means.max()),
                    "success_rate": float(np.mean(success)) if success else None,
                }
            )
    return rows


def _heading(dataset: Dataset) -> dict[str, Any]:
    return {"name": dataset.manifest.name, "environment": dataset.name}


def _episode(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "length": len(trajectory),
        "return": trajectory.undiscounted_return,
        "terminated": bool(trajectory.terminated.any()),
        "truncated": bool(trajectory.truncated.any()),
        "success": bool(np.any(trajectory.extras["success"])) if "success" in trajectory.extras else None,
    }


def _at(table: dict[str, Any], step: int, split: str) -> Iterator[dict[str, Any]]:
    for task in table["tasks"]:
        if task["split"] == split:
            yield from (found for found in task["snapshots"] if found["step"] == step)


LARGEST = 1e300
"""Numbers from here on are left out; an integer may have more digits than a float."""


@dataclass(frozen=True)
class ParameterShift:
    """One number of the tasks' parameters, in training and in test tasks.

    Attributes:
        parameter: what it is: the environment's ordering, or the dotted place of a number.
        standardized: the difference in standard deviations of the training tasks; None where these are equal
            and the test tasks differ from them.
    """

    parameter: str
    train: float
    test: float
    difference: float
    standardized: float | None


def parameter_shifts(dataset: Dataset) -> list[ParameterShift]:
    """The shift of the environment's ordering, or of every number of the parameters where it has none.

    Numbers that are equal in all tasks are left out. Empty without training or without test tasks.
    """
    splits = (dataset.train_tasks, dataset.test_tasks)
    train, test = ([_numbers(dataset, task) for task in tasks] for tasks in splits)
    if not train or not test:
        return []
    names = [name for name in train[0] if all(name in found for found in (*train, *test))]
    shifts = (
        _shift(name, [found[name] for found in train], [found[name] for found in test]) for name in names
    )
    return [shift for shift in shifts if shift is not None]


def shift_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """The shifts as JSON: `{"parameter", "train", "test", "difference", "standardized"}`."""
    return [asdict(shift) for shift in parameter_shifts(dataset)]


def _shift(name: str, train: Sequence[float], test: Sequence[float]) -> ParameterShift | None:
    if len({*train, *test}) == 1:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # a stranger's numbers may be of any size
        means, scale = (float(np.mean(train)), float(np.mean(test))), float(np.std(train))
        difference = means[1] - means[0]
    if not math.isfinite(difference) or not math.isfinite(scale):
        return None
    return ParameterShift(name, *means, difference, difference / scale if scale > 0 else None)


def _numbers(dataset: Dataset, task: Task) -> dict[str, float]:
    """The task's place in the environment's ordering, or all numbers of its parameters by dotted names."""
    try:
        environment = dataset.environment
    except TcmrlError:  # its package is not installed: what the parameters say is all that is known
        return dict(_flat(task.parameters))
    place = place_in_order(environment, task)
    if place is None or environment.ordering_name is None:
        return dict(_flat(task.parameters))
    return {environment.ordering_name: place}


def _flat(value: Any, place: str = "") -> Iterator[tuple[str, float]]:
    items: Iterator[tuple[Any, Any]] = iter(())
    if isinstance(value, Mapping):
        items = iter(value.items())
    elif isinstance(value, list | tuple):
        items = iter(enumerate(value))
    elif isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST:
        yield place, float(value)
    for name, member in items:
        yield from _flat(member, f"{place}.{name}" if place else str(name))
