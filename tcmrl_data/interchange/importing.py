"""Import: episodes that other programs recorded become a dataset."""

import dataclasses
import functools
import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import StoreError, TaskError
from tcmrl_data.foundation.files import one_line, printable, read_plain_file
from tcmrl_data.foundation.records import MAX_JSON_BYTES, digest, hidden_text, validate_table
from tcmrl_data.interchange.exporting import require_packages
from tcmrl_data.interchange.reader import READERS, Reader, ReadPart, Say, damage_at
from tcmrl_data.operations.assembly import derivation_of, open_assembly
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.recipe.imported import bound_recipe, check_licence, foreign_recipe
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import STANDARD_ARRAYS, PartRecord
from tcmrl_data.store.tables import (
    MAIN_RUN,
    MAX_ARRAYS,
    MAX_INDEX,
    PartKey,
    check_plan,
    parse_task_file,
    task_line,
)


@dataclass(frozen=True)
class ImportReport:
    """What an import made in the folder `out`, or would make.

    Attributes:
        environment: its name, `foreign` for one that is not ours.
        notes: what was cut or left out of the files, in words.
    """

    out: Path
    environment: str
    tasks: int
    parts: int
    episodes: int
    steps: int
    observation_dim: int
    action_dim: int
    horizon: int
    notes: tuple[str, ...]
    root: str | None


def import_dataset(
    format_name: str,
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    environment: str | None = None,
    task: int | None = None,
    tasks: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
    label: str | None = None,
    licence: str | None = None,
    url: str | None = None,
    dry_run: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Makes a dataset from the files of another program.

    All files are read and checked before anything is written, and once more while the parts are published.
    A stopped import goes on when it is called again with the same arguments and files.

    What files do not say stays open: there is no seed, no policy and no reference return, and a task
    has no parameters unless the files or `tasks` name them.

    Args:
        paths: files or folders, whichever the format has. Where they do not name their tasks, the first
            is task 0, the second task 1 and so on.
        environment: one of ours that the episodes come from; otherwise the dataset's environment is
            `foreign`, which has sizes and cannot be simulated.
        task: index of the first path's task, instead of 0.
        tasks: a JSON file with a list of `{"index", "split", "parameters"}`; of a task that it does not name,
            the files' own words hold, and what they do not name is a training task without parameters.
        options: of the reader.
        label: the dataset's own name.
        licence: of the data, an SPDX expression; recorded as their origin, like `url`.
        url: where the data come from.
        dry_run: read and check only.
        progress: called with the number of parts published and of all parts.

    Raises:
        UnknownNameError: there is no such reader or environment.
        RecipeError: SPDX does not know the licence.
        MissingPackageError: an optional package of the reader is not installed.
        StoreError: a file is damaged, not of the format, or larger inside than its size justifies; episodes
            do not fit each other or the environment; `out` is in use; a file changes meanwhile.
        TaskError: `tasks` cannot be read.
        BuildError: the dataset would exceed a limit.

    Example:
        >>> import tcmrl_data
        >>> report = tcmrl_data.import_dataset("hdf5", ["hopper.hdf5"], "data/hopper")  # doctest: +SKIP
        >>> report.environment  # doctest: +SKIP
        'foreign'
    """
    if hidden_text([label, licence, url]) is not None:
        raise StoreError("label, licence or url holds control characters; leave them out")
    check_licence(licence)
    kind = READERS.get(format_name)
    require_packages(f"import of {format_name}", kind.optional_packages, kind.extra)
    reader = kind(
        validate_table(kind.Options, options or {}, place=f"import of {format_name}", error=StoreError)
    )
    source = _Source(reader, [Path(path) for path in paths], first_task=task)
    digests = source.digests()
    notes: list[str] = []
    survey = _Survey()
    for path, index, part in source.parts(notes.append):
        try:
            survey.add(index, part)
        except StoreError as error:
            raise StoreError(f"{path}: {error}") from None
    known = survey.tasks if tasks is None else survey.tasks | _tasks_of_file(Path(tasks))
    imported = {index: known[index] for index in sorted(survey.tasks)}
    check_plan(
        tasks=len(imported),
        steps=max(Counter(key.task for key in survey.keys).values()),
        columns=max(survey.sizes),
        largest_task=max(len(task_line(task)) for task in imported.values()),
    )
    recipe, extras = recipe_of_episodes(
        environment,
        tasks=[*imported.values()],
        sizes=survey.sizes,
        horizon=survey.horizon,
        extras=survey.extras or {},
        licence=licence,
    )
    report = ImportReport(
        out=Path(out),
        environment=recipe.environment.name,
        tasks=len(imported),
        parts=len(survey.keys),
        episodes=survey.episodes,
        steps=survey.steps,
        observation_dim=survey.sizes[0],
        action_dim=survey.sizes[1],
        horizon=survey.horizon,
        notes=tuple(notes),
        root=None,
    )
    if dry_run:
        return report
    origin = {"format": format_name, "files": digests, "licence": licence, "url": url}
    settings = {
        "options": reader.options.model_dump(mode="json"),
        "origin": digest(origin),
        "tasks": digest([task_line(task).decode() for task in imported.values()]),
        "recipe": digest(recipe.unit_settings()),
    }
    run = Run(name=MAIN_RUN, kind="imported", seed=None, recipe=recipe, origin=origin, steps=None)
    with open_assembly(Path(out), derivation_of("import", settings, []), []) as assembly:
        for done, (_, index, part) in enumerate(source.parts(), start=1):
            make = functools.partial(_make_part, recipe, extras, imported[index], part)
            assembly.write(PartKey(index, part.step), make)
            if progress is not None:
                progress(done, report.parts)
        for before, now in zip(digests, source.digests(), strict=True):
            if before != now:
                raise StoreError(f"{now[0]} changed meanwhile; remove {out} and import again")
        manifest = assembly.finish(runs=[run], tasks=[*imported.values()], label=label)
    return dataclasses.replace(report, root=manifest.root)


@dataclass
class _Survey:
    """Sums and sizes of the parts that were added.

    Attributes:
        tasks: as the files describe them, by index.
        extras: dtypes of the per-step arrays that all episodes have, by name; None before the first one.
    """

    keys: set[PartKey] = field(default_factory=set)
    tasks: dict[int, Task] = field(default_factory=dict)
    episodes: int = 0
    steps: int = 0
    horizon: int = 0
    sizes: tuple[int, int] = (0, 0)
    extras: dict[str, str] | None = None

    def add(self, index: int, part: ReadPart) -> None:
        """Adds a part of the task with this index.

        Raises:
            StoreError: it stands in the files twice, or does not fit the parts before it.
        """
        key = PartKey(index, part.step)
        if not 0 <= min(key.task, key.step) <= max(key.task, key.step) < MAX_INDEX:
            raise StoreError(f"{key}: task and step must be from 0 to {MAX_INDEX - 1}")
        if key in self.keys:
            raise StoreError(
                f"{key} is in the files twice; give every file its task, or import them apart and merge"
            )
        self.keys.add(key)
        task = Task(index, part.task.split or "train", dict(part.task.parameters))
        hidden = hidden_text(task.parameters)
        if hidden is not None:
            raise StoreError(f"task {index}: parameters {printable(hidden)[:200]} hold control characters")
        if self.tasks.setdefault(index, task) != task:
            raise StoreError(f"task {index}: two files give it different parameters or splits")
        for trajectory in part.trajectories:
            self._add_episode(trajectory, key)

    def _add_episode(self, trajectory: Trajectory, key: PartKey) -> None:
        sizes = (trajectory.observations.shape[1], trajectory.actions.shape[1])
        if min(sizes) < 1:
            raise StoreError(f"{key}: observations and actions have {sizes} columns, 1 is the least")
        if self.episodes and sizes != self.sizes:
            raise StoreError(
                f"{key}: observations and actions have {sizes} columns, those of the parts before "
                f"{self.sizes}"
            )
        self.sizes = sizes
        self.episodes += 1
        self.steps += len(trajectory)
        self.horizon = max(self.horizon, len(trajectory))
        found = {name: str(array.dtype) for name, array in trajectory.extras.items()}
        kept = found.items() if self.extras is None else found.items() & self.extras.items()
        self.extras = dict(sorted(kept))
        if len(self.extras) > MAX_ARRAYS - len(STANDARD_ARRAYS):
            raise StoreError(
                f"{key}: has {len(found)} further arrays, a part has at most {MAX_ARRAYS} in all"
            )


@dataclass(frozen=True)
class _Source:
    """The paths of an import as one stream of parts."""

    reader: Reader
    paths: Sequence[Path]
    first_task: int | None

    def digests(self) -> list[list[str]]:
        """Names and digests of all paths."""
        if not self.paths:
            raise StoreError("no file is named; name at least one")
        return [_path_digest(path, self.reader.files(path)) for path in self.paths]

    def parts(self, say: Say | None = None) -> Iterator[tuple[Path, int, ReadPart]]:
        """The parts of all paths, with their paths and the indices of their tasks."""
        for position, path in enumerate(self.paths):
            own: set[int | None] = set()
            for part in self.reader.read(path, say):
                index = part.task.index
                if self.first_task is not None or index is None:
                    own.add(index)
                    index = (self.first_task or 0) + position
                if len(own) > 1:
                    raise StoreError(
                        f"{path} holds several tasks, which have their numbers; leave --first-task out"
                    )
                yield path, index, part


def recipe_of_episodes(
    environment: str | None,
    *,
    tasks: Sequence[Task],
    sizes: tuple[int, int],
    horizon: int,
    extras: Mapping[str, str],
    licence: str | None,
) -> tuple[Recipe, list[str]]:
    """The recipe of episodes that another program has made, and the further arrays that their parts keep.

    Args:
        environment: one of ours that they come from; None gives the environment `foreign`.
        tasks: of the dataset.
        sizes: widths of observations and actions.
        horizon: most steps of an episode.
        extras: dtypes of the further arrays by their names.
        licence: of the data.

    Raises:
        StoreError: the episodes do not fit the environment.
    """
    if environment is None:
        recipe = foreign_recipe(
            tasks=len(tasks),
            train=sum(task.split == "train" for task in tasks),
            horizon=horizon,
            observation_dim=sizes[0],
            action_dim=sizes[1],
            extra_arrays=extras,
            licence=licence,
        )
        return recipe, list(extras)
    recipe = bound_recipe(environment, licence=licence)
    made = recipe.make_environment()
    wanted, longest = (made.observation_dim, made.action_dim), made.settings.horizon
    if sizes != wanted or horizon > longest:
        raise StoreError(
            f"observations, actions and horizon are {(*sizes, horizon)}, those of {environment} "
            f"{(*wanted, longest)}; name another environment or none"
        )
    types = {name: str(np.dtype(dtype)) for name, dtype in made.extras.items()}
    return recipe, [name for name, dtype in extras.items() if types.get(name) == dtype]


def _make_part(recipe: Recipe, extras: Sequence[str], task: Task, part: ReadPart) -> tuple[PartRecord, bytes]:
    trajectories = [
        dataclasses.replace(trajectory, extras={name: trajectory.extras[name] for name in extras})
        for trajectory in part.trajectories
    ]
    return make_part(WantedPart(settings=recipe.unit_settings(), task=task, step=part.step), trajectories)


def _tasks_of_file(file: Path) -> dict[int, Task]:
    """The tasks of a JSON file, by index.

    Raises:
        TaskError: it cannot be read, or is no list of tasks.
    """
    try:
        data = read_plain_file(file.resolve(), limit=MAX_JSON_BYTES)
    except (OSError, ValueError) as error:
        raise TaskError(f"--task-file {file} cannot be read ({one_line(error)})") from None
    return {task.index: task for task in parse_task_file(data, file)}


def _path_digest(path: Path, files: Sequence[Path]) -> list[str]:
    """Name and sha256 of a path of the command line, as they stand in the origin of a run.

    A folder's is that of the names and digests of the files that are read of it, since there may be many.
    """
    name = printable(path.resolve().name)
    if len(files) == 1 and files[0] == path.resolve():
        return [name, _file_digest(files[0])]
    return [name, digest([[file.relative_to(path).as_posix(), _file_digest(file)] for file in files])]


def _file_digest(file: Path) -> str:
    with damage_at(f"{printable(str(file))} cannot be read:"), file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
