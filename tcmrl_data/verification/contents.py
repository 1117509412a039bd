"""Checks of a part's content: digests, episodes, values, flags, statistics and policy."""

import math
import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.snapshot import GaussianDescription, read_snapshot
from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.tasks import draw_tasks
from tcmrl_data.foundation.errors import SnapshotError, StoreError, TcmrlError, TrajectoryError
from tcmrl_data.foundation.validation import first_problem
from tcmrl_data.store.arrays import array_digests, read_arrays, unpack
from tcmrl_data.store.manifest import MAX_TASKS, STANDARD_ARRAYS, Manifest, PartRecord
from tcmrl_data.store.statistics import statistics

ContentProblem = tuple[str, str]
"""File or array within the part, and its problem."""

CLOSE = 1e-9
"""Relative tolerance of recomputed sums; the order of summation may depend on the machine."""


def content_problems(folder: Path, record: PartRecord, manifest: Manifest | None) -> Iterator[ContentProblem]:
    """Yields the problems of a part's content.

    Args:
        folder: the part; its layout has been checked.
        record: its record.
        manifest: what the dataset was built from; None where it cannot be read.
    """
    yield from _policy_problems(folder, record, manifest)
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, recorded in record.identity.arrays.items():
        try:
            arrays |= read_arrays(folder, [name])
        except StoreError as error:
            yield _place(error, folder, default=name)
            continue
        if array_digests({name: arrays[name]})[name] != recorded.model_dump(mode="json"):
            yield name, "decoded values do not have the recorded sha256"
    if len(arrays) < len(record.identity.arrays):
        return
    problems = list(_value_problems(arrays))
    yield from problems
    if manifest is not None:
        yield from _shape_problems(arrays, manifest)
    try:
        episodes = unpack(arrays)
    except (StoreError, TrajectoryError) as error:
        yield "episode_offsets", str(error)
        return
    yield from _flag_problems(arrays)
    if problems:
        return  # sums over values that are not finite say nothing
    found = statistics(episodes).model_dump()
    for field, recorded_value in record.statistics.model_dump().items():
        if not is_close(found[field], recorded_value):
            yield "part.json", f"statistics.{field} is not what the arrays give"


def task_problems(manifest: Manifest) -> Iterator[str]:
    """Yields the differences of the manifest's tasks from those that the recipe draws."""
    environment = _environment(manifest)
    if isinstance(environment, str):
        yield environment
        return
    if environment.settings.tasks > MAX_TASKS:
        yield f"recipe.environment.tasks is {environment.settings.tasks}, more than {MAX_TASKS}"
        return
    drawn = {task.index: task for task in draw_tasks(environment)}
    for task in manifest.tasks:
        if task.index not in drawn:
            yield f"tasks: task {task.index} is not in the recipe's task set"
        elif task.split != drawn[task.index].split:
            yield f"tasks: split of task {task.index} is not the one that the recipe draws"
        elif not is_close(task.parameters, dict(drawn[task.index].parameters)):
            yield f"tasks: parameters of task {task.index} are not those that the recipe draws"


def is_close(left: Any, right: Any) -> bool:
    """True if two JSON values are equal, with floats compared to a tolerance of `CLOSE`."""
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        return left.keys() == right.keys() and all(is_close(left[key], right[key]) for key in left)
    if isinstance(left, list | tuple) and isinstance(right, list | tuple):
        return len(left) == len(right) and all(is_close(*pair) for pair in zip(left, right, strict=True))
    if isinstance(left, float) and isinstance(right, int | float):
        return math.isclose(left, right, rel_tol=CLOSE, abs_tol=CLOSE)
    return bool(left == right)


def _place(error: Exception, folder: Path, *, default: str) -> ContentProblem:
    """The file within a part that an error names first, and the rest of the message."""
    match = re.fullmatch(r"([a-z0-9_./]+?):? (.*)", str(error).removeprefix(f"{folder}/"))
    return (match[1], match[2]) if match else (default, str(error))


def _environment(manifest: Manifest) -> Environment | str:
    """The manifest's environment, or the reason why it cannot be made."""
    try:
        return manifest.recipe.make_environment()
    except ValidationError as error:
        return f"recipe.environment: {first_problem(error)}"
    except TcmrlError as error:
        return f"recipe.environment: {error}"


def _policy_problems(folder: Path, record: PartRecord, manifest: Manifest | None) -> Iterator[ContentProblem]:
    try:
        snapshot = read_snapshot(folder, record.identity.step)
    except SnapshotError as error:
        yield _place(error, folder, default="policy.json")
        return
    if snapshot.digest() != record.identity.policy:
        yield "policy.json", "the policy does not have the recorded digest"
    if ("policy.safetensors" in record.files) != bool(snapshot.tensors):
        yield "part.json", "files and policy.json disagree on policy.safetensors"
    environment = None if manifest is None else _environment(manifest)
    if isinstance(snapshot.description, GaussianDescription) and isinstance(environment, Environment):
        sizes = (snapshot.description.observation_dim, snapshot.description.action_dim)
        if sizes != (environment.observation_dim, environment.action_dim):
            yield "policy.json", f"observation_dim and action_dim {sizes} are not the environment's"


def _value_problems(arrays: Mapping[str, npt.NDArray[Any]]) -> Iterator[ContentProblem]:
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            row = int(np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0])
            yield name, f"holds a value that is not finite, first in row {row}"
    largest = float(np.abs(arrays["actions"]).max(initial=0.0))
    if largest > 1.0:
        yield "actions", f"reach {largest:g}, outside [-1, 1]"


def _shape_problems(arrays: Mapping[str, npt.NDArray[Any]], manifest: Manifest) -> Iterator[ContentProblem]:
    episodes = len(arrays["episode_offsets"]) - 1
    if episodes != manifest.recipe.rollouts.episodes:
        yield "episode_offsets", f"{episodes} episodes, not the recipe's {manifest.recipe.rollouts.episodes}"
    environment = _environment(manifest)
    if isinstance(environment, str):
        yield "part.json", environment
        return
    for name, width in (("observations", environment.observation_dim), ("actions", environment.action_dim)):
        if arrays[name].shape[1] != width:
            yield name, f"have {arrays[name].shape[1]} columns, {environment.name} has {width}"
    extras = {name: str(array.dtype) for name, array in arrays.items() if name not in STANDARD_ARRAYS}
    wanted = {name: str(np.dtype(dtype)) for name, dtype in environment.extras.items()}
    if extras != wanted:
        yield "part.json", f"extra arrays {extras} are not the environment's {wanted}"
    longest = int(np.diff(arrays["episode_offsets"]).max(initial=0))
    if longest > environment.settings.horizon:
        yield "episode_offsets", f"an episode of {longest} steps, horizon {environment.settings.horizon}"


def _flag_problems(arrays: Mapping[str, npt.NDArray[Any]]) -> Iterator[ContentProblem]:
    """Episodes end where a flag is set and only there.

    Both flags may stand at one step: a task may end on the very step of its time limit.
    """
    ended = arrays["terminated"] | arrays["truncated"]
    for episode, (start, stop) in enumerate(pairwise(arrays["episode_offsets"].tolist())):
        if ended[start : stop - 1].any():
            yield "terminated", f"or truncated is set before the last step of episode {episode}"
        if stop > start and not ended[stop - 1]:
            yield "truncated", f"nor terminated is set at the end of episode {episode}"
