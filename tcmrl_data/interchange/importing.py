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

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.canonical import MAX_JSON_BYTES, digest
from tcmrl_data.foundation.errors import StoreError, TaskError
from tcmrl_data.foundation.plain_files import one_line, printable, read_plain_file
from tcmrl_data.foundation.records import hidden_text, validate_table
from tcmrl_data.interchange.exporting import require_packages
from tcmrl_data.interchange.reader import READERS, Reader, ReadPart, Say
from tcmrl_data.operations.assembly import Assembly, derivation_of, open_assembly
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.recipe.recipe import Recipe, bound_recipe, check_licence, foreign_recipe
from tcmrl_data.store.keys import MAIN_RUN, MAX_ARRAYS, MAX_INDEX, PartKey, check_plan
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import DATA_VERSION, STANDARD_ARRAYS, PartRecord
from tcmrl_data.store.tables import parse_task_file, task_line


@dataclass(frozen=True)
class ImportReport:
    """What an import made, or would make.

    Attributes:
        out: the dataset's folder.
        environment: the environment's name, `foreign` for one that is not ours.
        tasks: number of tasks.
        parts: number of parts.
        episodes: number of episodes.
        steps: number of steps.
        observation_dim: width of observations.
        action_dim: width of actions.
        horizon: steps of the longest episode.
        notes: what was cut or left out of the files, in words.
        root: of the dataset; None where nothing was written.
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
        format_name: a reader, such as `hdf5`.
        paths: files or folders, whichever the format has. Where they do not name their tasks, the first
            is task 0, the second task 1 and so on.
        out: folder of the new dataset.
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
    for path, part in source.parts(notes.append):
        try:
            survey.add(part)
        except StoreError as error:
            raise StoreError(f"{path}: {error}") from None
    known = {} if tasks is None else _tasks_of_file(Path(tasks))
    plan = _plan(survey, known, environment=environment, licence=licence)
    report = ImportReport(
        out=Path(out),
        environment=plan.recipe.environment.name,
        tasks=len(plan.tasks),
        parts=len(survey.keys),
        episodes=survey.episodes,
        steps=survey.steps,
        observation_dim=survey.observation_dim,
        action_dim=survey.action_dim,
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
        "tasks": digest([task_line(task).decode() for task in plan.tasks]),
        "recipe": digest(plan.recipe.unit_settings()),
    }
    run = Run(name=MAIN_RUN, kind="imported", seed=None, recipe=plan.recipe, origin=origin, steps=None)
    with open_assembly(Path(out), derivation_of("import", settings, []), []) as assembly:
        _publish(assembly, source, plan, progress, total=report.parts)
        for before, now in zip(digests, source.digests(), strict=True):
            if before != now:
                raise StoreError(f"{now[0]} changed meanwhile; remove {out} and import again")
        manifest = assembly.finish(
            name=report.environment, data_version=DATA_VERSION, runs=[run], tasks=plan.tasks, label=label
        )
    return dataclasses.replace(report, root=manifest.root)


@dataclass
class _Survey:
    """Sums and sizes of the parts that were added.

    Attributes:
        keys: of the parts.
        tasks: as the files describe them, by index.
        horizon: steps of the longest episode.
        extras: dtypes of the per-step arrays that all episodes have, by name.
    """

    keys: set[PartKey] = field(default_factory=set)
    tasks: dict[int, Task] = field(default_factory=dict)
    episodes: int = 0
    steps: int = 0
    horizon: int = 0
    observation_dim: int = 0
    action_dim: int = 0
    _extras: dict[str, str] | None = None

    @property
    def extras(self) -> dict[str, str]:
        """Dtypes of the per-step arrays that all episodes have, by name."""
        return dict(sorted((self._extras or {}).items()))

    def steps_of_tasks(self) -> list[int]:
        """Number of snapshot steps of every task."""
        return list(Counter(key.task for key in self.keys).values())

    def add(self, part: ReadPart) -> None:
        """Adds a part.

        Raises:
            StoreError: it stands in the files twice, or does not fit the parts before it.
        """
        assert part.task is not None
        key = PartKey(part.task, part.step)
        if not 0 <= min(key.task, key.step) <= max(key.task, key.step) < MAX_INDEX:
            raise StoreError(f"{key}: task and step must be from 0 to {MAX_INDEX - 1}")
        if key in self.keys:
            raise StoreError(
                f"{key} is in the files twice; give every file its task, or import them apart and merge"
            )
        self.keys.add(key)
        self._add_task(part)
        for trajectory in part.trajectories:
            sizes = (trajectory.observations.shape[1], trajectory.actions.shape[1])
            if min(sizes) < 1:
                raise StoreError(f"{key}: observations and actions have {sizes} columns, 1 is the least")
            if self.episodes and sizes != (self.observation_dim, self.action_dim):
                raise StoreError(
                    f"{key}: observations and actions have {sizes} columns, those of the parts before "
                    f"{(self.observation_dim, self.action_dim)}"
                )
            self.observation_dim, self.action_dim = sizes
            self.episodes += 1
            self.steps += len(trajectory)
            self.horizon = max(self.horizon, len(trajectory))
            found = self.named_types({name: array.dtype for name, array in trajectory.extras.items()})
            before = found if self._extras is None else self._extras
            self._extras = dict(found.items() & before.items())
            if len(self._extras) > MAX_ARRAYS - len(STANDARD_ARRAYS):
                raise StoreError(
                    f"{key}: has {len(found)} further arrays, a part has at most {MAX_ARRAYS} in all"
                )

    @staticmethod
    def named_types(types: Mapping[str, Any]) -> dict[str, str]:
        """The names of dtypes."""
        return {name: str(np.dtype(dtype)) for name, dtype in types.items()}

    def _add_task(self, part: ReadPart) -> None:
        assert part.task is not None
        hidden = hidden_text(dict(part.about.parameters))
        if hidden is not None:
            place = printable(hidden)[:200]
            raise StoreError(f"task {part.task}: parameters {place} hold control characters")
        task = Task(part.task, part.about.split or "train", dict(part.about.parameters))
        known = self.tasks.setdefault(part.task, task)
        if known != task:
            raise StoreError(f"task {part.task}: two files give it different parameters or splits")


@dataclass(frozen=True)
class _Plan:
    """What the parts of an import have in common."""

    recipe: Recipe
    tasks: tuple[Task, ...]
    extras: frozenset[str]


@dataclass(frozen=True)
class _Source:
    """The paths of an import as one stream of parts that name their tasks."""

    reader: Reader
    paths: Sequence[Path]
    first_task: int | None

    def digests(self) -> list[list[str]]:
        """Names and digests of all paths."""
        if not self.paths:
            raise StoreError("no file is named; name at least one")
        return [_path_digest(path, self.reader.files(path)) for path in self.paths]

    def parts(self, say: Say | None = None) -> Iterator[tuple[Path, ReadPart]]:
        """The parts of all paths, with their paths."""
        for position, path in enumerate(self.paths):
            own: set[int] = set()
            for part in self.reader.read(path, say):
                index = part.task
                if self.first_task is not None or index is None:
                    own.add(-1 if index is None else index)
                    index = (self.first_task or 0) + position
                if len(own) > 1:
                    raise StoreError(
                        f"{path} holds several tasks, which have their numbers; leave --task out"
                    )
                yield path, dataclasses.replace(part, task=index)


def _plan(
    survey: _Survey, known: Mapping[int, Task], *, environment: str | None, licence: str | None
) -> _Plan:
    """The recipe and the tasks of an import.

    Raises:
        StoreError: the episodes do not fit the environment.
        BuildError: the dataset would exceed a limit.
    """
    extras = survey.extras
    found = {index: known.get(index, task) for index, task in survey.tasks.items()}
    tasks = tuple(found[index] for index in sorted(found))
    check_plan(
        tasks=len(tasks),
        steps=max(survey.steps_of_tasks()),
        columns=max(survey.observation_dim, survey.action_dim),
        largest_task=max(len(task_line(task)) for task in tasks),
    )
    if environment is None:
        recipe = foreign_recipe(
            tasks=len(tasks),
            train=sum(task.split == "train" for task in tasks),
            horizon=survey.horizon,
            observation_dim=survey.observation_dim,
            action_dim=survey.action_dim,
            extra_arrays=extras,
            licence=licence,
        )
        return _Plan(recipe, tasks, frozenset(extras))
    recipe = bound_recipe(environment, licence=licence)
    made = recipe.make_environment()
    for what, value, wanted in (
        ("columns of observations", survey.observation_dim, made.observation_dim),
        ("columns of actions", survey.action_dim, made.action_dim),
    ):
        if value != wanted:
            raise StoreError(
                f"the files have {value} {what}, {environment} has {wanted}; name another environment"
            )
    if survey.horizon > made.settings.horizon:
        raise StoreError(
            f"the files have an episode of {survey.horizon} steps, the horizon of {environment} is "
            f"{made.settings.horizon}; name another --environment or none"
        )
    wanted_extras = {name: str(dtype) for name, dtype in survey.named_types(made.extras).items()}
    kept = frozenset(name for name, dtype in extras.items() if wanted_extras.get(name) == dtype)
    return _Plan(recipe, tasks, kept)


def _publish(
    assembly: Assembly,
    source: _Source,
    plan: _Plan,
    progress: Callable[[int, int], None] | None,
    *,
    total: int,
) -> None:
    """Writes the parts that no earlier attempt has written."""
    tasks = {task.index: task for task in plan.tasks}
    for done, (_, part) in enumerate(source.parts(), start=1):
        assert part.task is not None
        task = tasks[part.task]
        assembly.write(PartKey(task.index, part.step), functools.partial(_make_part, plan, task, part))
        if progress is not None:
            progress(done, total)


def _make_part(plan: _Plan, task: Task, part: ReadPart) -> tuple[PartRecord, bytes]:
    trajectories = [
        dataclasses.replace(
            trajectory, extras={name: trajectory.extras[name] for name in sorted(plan.extras)}
        )
        for trajectory in part.trajectories
    ]
    return make_part(
        WantedPart(settings=plan.recipe.unit_settings(), task=task, step=part.step), trajectories
    )


def _tasks_of_file(file: Path) -> dict[int, Task]:
    """The tasks of a JSON file, by index.

    Raises:
        TaskError: it cannot be read, or is no list of tasks.
    """
    try:
        data = read_plain_file(file.resolve(), limit=MAX_JSON_BYTES)
    except (OSError, ValueError) as error:
        raise TaskError(f"--tasks {file} cannot be read ({one_line(error)})") from None
    return {task.index: task for task in parse_task_file(data, file)}


def _path_digest(path: Path, files: Sequence[Path]) -> list[str]:
    """Name and sha256 of a path of the command line, as they stand in the origin of a run.

    A folder's is that of the names and digests of the files that are read of it, since there may be many.

    Raises:
        StoreError: a file cannot be read.
    """
    name = printable(path.resolve().name)
    if len(files) == 1 and files[0] == path.resolve():
        return [name, _file_digest(files[0])]
    return [name, digest([[file.relative_to(path).as_posix(), _file_digest(file)] for file in files])]


def _file_digest(file: Path) -> str:
    try:
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        raise StoreError(f"{printable(str(file))} cannot be read ({one_line(error)})") from None
