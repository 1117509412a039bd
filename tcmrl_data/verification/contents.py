"""Checks of one part: against its line in the table, and of its content."""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.base import GaussianDescription, read_snapshot
from tcmrl_data.envs.base import Environment, Split, Task, draw_tasks
from tcmrl_data.foundation.errors import ManifestError, SnapshotError, StoreError, TcmrlError, TrajectoryError
from tcmrl_data.foundation.files import file_problem, folder_problem, one_line, words_after
from tcmrl_data.foundation.records import first_problem
from tcmrl_data.parts.making import statistics
from tcmrl_data.parts.own_operations import SUBSET, read_cut
from tcmrl_data.recipe.recipe import Recipe, same_settings
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import array_digests, read_arrays, unpack
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import POLICY, RECORD, STANDARD_ARRAYS, PartRecord, check_members, read_part_record
from tcmrl_data.store.part_table import REFERENCES, STATISTICS, PartEntry
from tcmrl_data.store.tables import MAX_TASKS, TASKS
from tcmrl_data.verification.description import Description, VerifyLevel

DERIVED_KINDS = ("extended", "relabelled")
"""Kinds of runs whose parts name the task that their policy or their episodes come from."""


class PartChecks:
    """Checks of the parts of a dataset; threads may share them."""

    def __init__(self, folder: Path, level: VerifyLevel, description: Description) -> None:
        self._folder, self._level, self._description = folder, level, description
        runs = description.manifest.runs if description.manifest else ()
        self._runs = {run.name: run for run in runs}
        self._settings = {run.name: run.recipe.unit_settings() for run in runs if run.recipe is not None}
        self._tasks = {task.index: task for task in description.tasks}

    def problems(
        self, file: str, status: os.stat_result | None, entry: PartEntry | None, *, opened: bool = True
    ) -> Iterator[str]:
        """Yields what is wrong with a part.

        Args:
            entry: its line in the table; None where the table cannot tell.
        """
        if status is None:
            blocked = folder_problem(self._folder, file.rpartition("/")[0])
            in_the_way = blocked is not None and os.path.lexists(self._folder / blocked[0])
            yield f"cannot be reached: {blocked[0]} {blocked[1]}" if blocked and in_the_way else "is missing"
            return
        odd = file_problem(status)
        if odd is not None:
            yield odd
        elif entry is not None and status.st_size != entry.size:
            yield f"has {status.st_size} bytes instead of {entry.size}"
        elif self._level != "quick" and opened:
            try:
                with Archive(self._folder / file) as archive:
                    yield from self._archive_problems(archive, entry)
            except (StoreError, ManifestError) as error:
                yield words_after(error, self._folder / file)

    def _archive_problems(self, archive: Archive, entry: PartEntry | None) -> Iterator[str]:
        if entry is not None and archive.sha256() != entry.sha256:
            yield "content does not have the recorded sha256"
            return
        if entry is None or self._level == "deep":
            archive.check_form()
        record = read_part_record(archive)
        check_members(archive, record)
        if entry is not None:
            yield from self._record_problems(record, entry)
        if self._level == "deep":
            run = self._runs.get(entry.run) if entry else None
            for name, problem in content_problems(archive, record, run.recipe if run else None):
                yield f"{name}: {problem}"

    def _record_problems(self, record: PartRecord, entry: PartEntry) -> Iterator[str]:
        assert self._description.manifest is not None
        run, task = self._runs.get(entry.run), self._tasks.get(entry.task)
        if TASKS in self._description.unreadable:  # a finding of its own; the part tells its task
            task = Task(entry.task, "train", record.identity.parameters)
        if run is None or task is None or entry.platform >= len(self._description.manifest.platforms):
            yield "is of a task, a run or a platform that the dataset does not have"
            return
        if record.platform != self._description.manifest.platforms[entry.platform]:
            yield "was made on another platform than the dataset says"
        yield from self._identity_problems(record, entry, task, run)

    def _identity_problems(self, record: PartRecord, entry: PartEntry, task: Task, run: Run) -> Iterator[str]:
        """How a part's record differs from what the dataset says of it."""
        identity, manifest = record.identity, self._description.manifest
        assert manifest is not None
        for name, found, wanted in (
            ("id", record.id, entry.id),
            ("identity.task", identity.task, entry.task),
            ("identity.step", identity.step, entry.step),
            ("identity.data_version", identity.data_version, manifest.data_version),
            ("identity.parameters", identity.parameters, task.parameters),
            ("identity.seed", identity.seed, identity.seed if run.seed is None else run.seed),
        ):
            if found != wanted:
                yield f"{name} is not the manifest's"
        settings = self._settings.get(run.name)  # of the run's recipe; None where the run was not built
        if settings is not None and not same_settings(identity.settings, settings):
            yield "identity.settings is not the manifest's"
        made = (identity.derived or {}).get("settings")
        if run.kind in DERIVED_KINDS and (
            not isinstance(made, dict) or made.get("task") != run.source_of(task.index)
        ):
            yield "identity.derived.settings.task is not the manifest's"
        for name in STATISTICS:
            if getattr(record.statistics, name) != getattr(entry, name):
                yield f"statistics.{name} is not that of parts.jsonl"
        for name in REFERENCES:
            if getattr(record.references, name) != getattr(entry, name):
                yield f"references.{name} is not that of parts.jsonl"


ContentProblem = tuple[str, str]
"""File or array within the part, and its problem."""

CLOSE = 1e-9
"""Relative tolerance of recomputed sums; the order of summation may depend on the machine."""


def content_problems(archive: Archive, record: PartRecord, recipe: Recipe | None) -> Iterator[ContentProblem]:
    """Yields the problems of a part's content.

    Args:
        archive: the part; its members have been checked.
        recipe: what it was built from; None where that is not known.
    """
    environment = None if recipe is None else recipe_environment(recipe)
    if (record.identity.derived or {}).get("operation") == SUBSET:
        try:
            read_cut(record.identity)
        except ValueError as error:
            yield RECORD, f"identity.derived {one_line(error)}"
    yield from _policy_problems(archive, record, environment)
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, recorded in record.identity.arrays.items():
        try:
            arrays |= read_arrays(archive, [name])
        except StoreError as error:
            yield name, words_after(error, archive.path)
            continue
        if array_digests({name: arrays[name]})[name] != recorded.model_dump(mode="json"):
            yield name, "decoded values do not have the recorded sha256"
    if len(arrays) < len(record.identity.arrays):
        return
    problems = list(_value_problems(arrays))
    yield from problems
    if recipe is not None and environment is not None:
        yield from _shape_problems(
            arrays, recipe, environment, is_derived=record.identity.derived is not None
        )
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
            yield RECORD, f"statistics.{field} is not what the arrays give"


def task_problems(tasks: Sequence[Task], recipe: Recipe, splits: Mapping[int, Split]) -> Iterator[str]:
    """Yields the differences of a dataset's tasks from those that its recipe draws.

    Args:
        splits: of tasks whose split is not the one that the recipe draws, as a derivation says.
    """
    environment = recipe_environment(recipe)
    if isinstance(environment, str):
        yield environment
        return
    drawn = {task.index: task for task in draw_tasks(environment)}
    for task in tasks:
        if task.index not in drawn:
            yield f"task {task.index} is not in the recipe's task set"
        elif task.split != splits.get(task.index, drawn[task.index].split):
            source = "derivation says" if task.index in splits else "recipe draws"
            yield f"split of task {task.index} is not the one that the {source}"
        elif not is_close(task.parameters, dict(drawn[task.index].parameters)):
            yield f"parameters of task {task.index} are not those that the recipe draws"


def is_close(left: Any, right: Any) -> bool:
    """True if two JSON values are equal, with floats compared to a tolerance of `CLOSE`."""
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        return left.keys() == right.keys() and all(is_close(left[key], right[key]) for key in left)
    if isinstance(left, list | tuple) and isinstance(right, list | tuple):
        return len(left) == len(right) and all(is_close(*pair) for pair in zip(left, right, strict=True))
    if isinstance(left, float) and isinstance(right, int | float):
        return math.isclose(left, right, rel_tol=CLOSE, abs_tol=CLOSE)
    return bool(left == right)


def recipe_environment(recipe: Recipe) -> Environment | str:
    """The recipe's environment, or the reason why it cannot be made or has more tasks than a dataset may."""
    try:
        environment = recipe.make_environment()
    except ValidationError as error:
        return f"recipe.environment: {first_problem(error)}"
    except TcmrlError as error:
        return f"recipe.environment: {error}"
    if environment.settings.tasks > MAX_TASKS:
        return f"recipe.environment.tasks is {environment.settings.tasks}, more than {MAX_TASKS}"
    return environment


def _policy_problems(
    archive: Archive, record: PartRecord, environment: Environment | str | None
) -> Iterator[ContentProblem]:
    if record.identity.policy is None:
        return
    try:
        snapshot = read_snapshot(archive.read, record.identity.step, place=str(archive.path))
    except SnapshotError as error:
        yield "policy", words_after(error, archive.path)
        return
    if snapshot.digest() != record.identity.policy:
        yield "policy.json", "the policy does not have the recorded digest"
    if (POLICY[1] in archive.names) != bool(snapshot.tensors):
        yield "policy.json", "does not agree with policy.safetensors"
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


def _shape_problems(
    arrays: Mapping[str, npt.NDArray[Any]],
    recipe: Recipe,
    environment: Environment | str,
    *,
    is_derived: bool,
) -> Iterator[ContentProblem]:
    """Differences from what the recipe calls for; derived parts may lack episodes and extra arrays."""
    episodes = len(arrays["episode_offsets"]) - 1
    is_whole = recipe.rollouts.episodes > 0 and not is_derived
    if is_whole and episodes != recipe.rollouts.episodes:
        yield "episode_offsets", f"{episodes} episodes, not the recipe's {recipe.rollouts.episodes}"
    if isinstance(environment, str):
        yield RECORD, environment
        return
    for name, width in (("observations", environment.observation_dim), ("actions", environment.action_dim)):
        if arrays[name].shape[1] != width:
            yield name, f"have {arrays[name].shape[1]} columns, {environment.name} has {width}"
    extras = {name: str(array.dtype) for name, array in arrays.items() if name not in STANDARD_ARRAYS}
    wanted = {name: str(np.dtype(dtype)) for name, dtype in environment.extras.items()}
    if extras != wanted and (is_whole or not extras.items() <= wanted.items()):
        yield RECORD, f"extra arrays {extras} are not the environment's {wanted}"
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
