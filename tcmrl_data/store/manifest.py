"""`manifest.json`: what a dataset is, in a few kilobytes, sealed by its own digest.

Tasks and parts stand in tables beside it (`tables.py`). The manifest seals them by length and sha256, and a
dataset exists when its manifest does.
"""

import contextlib
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import FailFast, Field, field_validator, model_validator

from tcmrl_data.envs.base import Split, Task
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.files import one_line, read_plain_file, words_after
from tcmrl_data.foundation.records import (
    MAX_JSON_BYTES,
    Kind,
    Record,
    parse_json,
    parse_record,
    read_ranges,
    sealed,
)
from tcmrl_data.recipe import Profile
from tcmrl_data.recipe.document import AND, joined_licences
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.part import Platform
from tcmrl_data.store.part_table import HEADER, PARTS_TABLE, PartTable, part_line
from tcmrl_data.store.tables import (
    MAX_COUNT,
    MAX_INDEX,
    MAX_PARTS,
    MAX_PLATFORMS,
    MAX_RUNS,
    MAX_TASKS,
    RUN_NAME,
    SHA256,
    TASKS,
    TableSeal,
    seal_of,
    task_line,
)

MANIFEST_SCHEMA = 2
"""Raised when the meaning or the layout of a dataset's files changes."""

MANIFEST = "manifest.json"
MANIFEST_COPY = ".manifest.json"
"""The same bytes again, from which `restore_manifest` writes a manifest that was lost or damaged."""

_Index = Annotated[int, Field(ge=0, lt=MAX_INDEX)]

RunKind = Literal["built", "extended", "relabelled", "derived", "imported", "recorded", "subset"]

FOREIGN_KINDS: tuple[RunKind, ...] = ("imported", "recorded")
"""Runs whose episodes were not made here: nothing of them can be made again."""


class Run(Record):
    """Parts of a dataset that were made in one way.

    Attributes:
        kind: how its parts came to be.
        seed: root seed; null where none is known.
        recipe: what it was built from; null where nothing was built and another run has the recipe. That of
            imported and recorded episodes says of which environment they are, and no rollouts.
        origin: where its parts come from, if they were not built.
        steps: snapshot steps that every task is to have; null where no more is expected than there is.
        sources: pairs of a task and the other task whose policy or episodes its parts come from, ascending.
    """

    name: str = Field(pattern=rf"^{RUN_NAME}$")
    kind: RunKind
    seed: int | None = Field(ge=0)
    recipe: Recipe | None
    origin: dict[str, Any] | None = None
    steps: tuple[_Index, ...] | None
    sources: tuple[tuple[int, int], ...] = Field(default=(), max_length=MAX_TASKS)

    @model_validator(mode="after")
    def _are_sorted(self) -> "Run":
        if self.steps is not None and list(self.steps) != sorted(set(self.steps)):
            raise ValueError("steps must be sorted, each once")
        tasks = [task for task, _ in self.sources]
        if tasks != sorted(set(tasks)):
            raise ValueError("sources must be sorted, each task once")
        return self

    def source_of(self, task: int) -> int:
        """The task that the run's parts of a task come from, which is the same one for rollouts in it."""
        return dict(self.sources).get(task, task)


class Source(Record):
    """A dataset that another one was derived from."""

    label: str | None
    root: str = Field(pattern=SHA256)


FOLD, EPISODES = "fold", "episodes"
"""The operations that make several datasets of one."""


class Derivation(Record):
    """How a dataset was derived from others.

    Attributes:
        operation: such as `subset` or `merge`.
        settings: of the operation.
        sources: the datasets that it read.
        package: version of tcmrl that did it.
        splits: tasks of each split, such as `0-9,12`, where they are not as the recipe draws them.
    """

    operation: str = Field(pattern=r"^[a-z0-9_-]{1,64}$")
    settings: dict[str, Any]
    sources: tuple[Source, ...]
    package: str
    splits: dict[Split, str] | None = None

    @field_validator("splits")
    @classmethod
    def _splits_are_ranges(cls, splits: dict[Split, str] | None) -> dict[Split, str] | None:
        members = [read_ranges(text, limit=MAX_TASKS) for text in (splits or {}).values()]
        if len({task for tasks in members for task in tasks}) < sum(map(len, members)):
            raise ValueError("a task is in two splits")
        return splits

    def split_of_tasks(self) -> dict[int, Split]:
        """The splits of `splits`, by task."""
        return {
            task: split
            for split, text in (self.splits or {}).items()
            for task in read_ranges(text, limit=MAX_TASKS)
        }


class Totals(Record):
    """Sums over the dataset's parts.

    Attributes:
        bytes: size of the archives.
    """

    parts: int = Field(ge=0, le=MAX_PARTS)
    episodes: int = Field(ge=0, lt=MAX_COUNT)
    steps: int = Field(ge=0, lt=MAX_COUNT)
    bytes: int = Field(ge=0, lt=MAX_COUNT)


class Manifest(Record):
    """`manifest.json`.

    Attributes:
        digest: sha256 of the canonical form of all other fields.
        name: the environment's name.
        label: the dataset's own name.
        runs: how the parts were made; the first has the recipe that the dataset goes by.
        derivation: how the dataset was derived from others; null for one that was built.
        platforms: on which the parts were made; parts refer to them by position.
        tasks: seal of `tasks.jsonl`.
        parts: seal of `parts.jsonl`.
        dropped: tasks that no longer belong to the dataset, though their lines and parts are there.
        totals: over the parts that belong to the dataset.
        root: digest of the parts' keys and ids (`PartTable.root`): equal data, equal root.
        complete: every task has the snapshots of every run.
    """

    schema_version: int
    digest: str = Field(pattern=SHA256)
    name: str = Field(pattern=r"^[a-z0-9_/-]{1,64}$")
    label: str | None = Field(default=None, max_length=200)
    data_version: int
    runs: Annotated[tuple[Run, ...], FailFast()] = Field(min_length=1, max_length=MAX_RUNS)
    derivation: Derivation | None = None
    platforms: Annotated[tuple[Platform, ...], FailFast()] = Field(max_length=MAX_PLATFORMS)
    tasks: TableSeal
    parts: TableSeal
    dropped: tuple[_Index, ...] = Field(max_length=MAX_TASKS)
    totals: Totals
    root: str = Field(pattern=SHA256)
    complete: bool

    @property
    def recipe(self) -> Recipe:
        """The recipe that the dataset goes by: that of its first run."""
        assert self.runs[0].recipe is not None  # the validator saw to it
        return self.runs[0].recipe

    @property
    def seed(self) -> int | None:
        """Root seed of the first run."""
        return self.runs[0].seed

    @property
    def steps(self) -> tuple[int, ...] | None:
        """Snapshot steps of the first run."""
        return self.runs[0].steps

    @property
    def profile(self) -> Profile:
        """The profile that the dataset was built with."""
        return self.recipe.profile

    @property
    def licences(self) -> tuple[str, ...]:
        """The licences of all runs, sorted; a run without a recipe has that of the first one."""
        found = [run.recipe.about.licence for run in self.runs if run.recipe is not None]
        return tuple(joined_licences(found).split(AND))

    @property
    def training(self) -> dict[Profile, dict[str, Any]]:
        """Training defaults per profile."""
        return self.recipe.training

    @property
    def is_drawn(self) -> bool:
        """Whether the recipe drew the tasks; those of a foreign dataset are as its source has them."""
        return self.runs[0].kind not in FOREIGN_KINDS

    @property
    def num_tasks(self) -> int:
        """Number of tasks that belong to the dataset."""
        return self.tasks.lines - len(self.dropped)

    @property
    def num_expected(self) -> int:
        """Number of parts of the complete dataset, with those that no run plans."""
        planned = sum(len(run.steps) for run in self.runs if run.steps is not None) * self.num_tasks
        return max(planned, self.totals.parts)

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> "Manifest":
        names = [run.name for run in self.runs]
        if len(set(names)) < len(names):
            raise ValueError("runs must have different names")
        if self.runs[0].recipe is None or self.recipe.environment.name != self.name:
            raise ValueError("recipe.environment.name is not the manifest's name")
        if list(self.dropped) != sorted(set(self.dropped)):
            raise ValueError("dropped must be sorted, each once")
        if self.num_tasks < 0 or self.tasks.lines > MAX_TASKS or self.parts.lines > 1 + MAX_PARTS:
            raise ValueError(f"a dataset has at most {MAX_TASKS} tasks and {MAX_PARTS} parts")
        if self.num_expected > MAX_PARTS:
            raise ValueError(f"the runs call for {self.num_expected} parts, more than {MAX_PARTS}")
        return self


def dataset_folder(path: str | os.PathLike[str]) -> Path:
    """The folder of a dataset, given the folder or its `manifest.json`.

    Raises:
        ManifestError: it is an address, whose files are not on this disk.
    """
    if "://" in os.fspath(path):
        raise ManifestError(f"{path} is not on this disk; fetch it with `tcmrl-data pull {path} FOLDER`")
    path = Path(path)
    return path.parent if path.name == MANIFEST else path


def read_manifest(path: Path) -> Manifest:
    """Reads and checks `manifest.json`, given the file or its dataset's folder.

    Raises:
        ManifestError: missing, truncated, edited, or of another schema version; names file and field.
    """
    folder = dataset_folder(path)
    try:
        return _parse_manifest(folder / MANIFEST)[1]
    except ManifestError as error:
        if not (folder / MANIFEST_COPY).exists():
            raise
        raise ManifestError(
            f"{error}; `tcmrl-data verify {folder} --repair` restores it from its copy"
        ) from None


def write_manifest(folder: Path, data: bytes) -> None:
    """Replaces the manifest of a dataset, which is another one from then on, and then the copy of it."""
    for name in (MANIFEST, MANIFEST_COPY):
        replace_file(folder / name, data, staging=folder / STAGING)


def restore_manifest(folder: Path) -> bool:
    """Writes the manifest again from its copy if it is lost or damaged, or the copy if that is.

    Returns:
        Whether the manifest had to be restored.

    Raises:
        ManifestError: the manifest is lost or damaged, and so is its copy.
    """
    try:
        data, _ = _parse_manifest(folder / MANIFEST)
        is_lost = False
    except ManifestError as error:
        try:
            data, _ = _parse_manifest(folder / MANIFEST_COPY)
        except ManifestError:
            raise error from None
        is_lost = True
    with contextlib.suppress(OSError, ValueError):
        if not is_lost and read_plain_file(folder / MANIFEST_COPY, limit=MAX_JSON_BYTES) == data:
            return False
    write_manifest(folder, data)
    return is_lost


def copy_problem(folder: Path) -> str | None:
    """Why the manifest cannot be restored from its copy; None where it can, or there never was one."""
    try:
        if (folder / MANIFEST_COPY).exists():
            _parse_manifest(folder / MANIFEST_COPY)
    except ManifestError as error:
        return words_after(error, folder / MANIFEST_COPY)
    return None


def _parse_manifest(file: Path) -> tuple[bytes, Manifest]:
    missing = f"build a dataset with `tcmrl-data build ENV --out {file.parent}`"
    return read_document(Manifest, file, version=MANIFEST_SCHEMA, missing=missing, damaged="not a manifest")


def read_document(
    kind: type[Kind], file: Path, *, version: int, missing: str, damaged: str
) -> tuple[bytes, Kind]:
    """The content of a JSON file that holds its own digest, and what it says.

    Raises:
        ManifestError: the file is `missing` or `damaged`, in these words, or its digest or a field is wrong.
    """
    try:
        data = read_plain_file(file, limit=MAX_JSON_BYTES)
        values = parse_json(data)
    except (FileNotFoundError, NotADirectoryError):
        raise ManifestError(f"{file} does not exist; {missing}") from None
    except (OSError, ValueError) as error:
        raise ManifestError(f"{file}: {damaged} ({one_line(error)})") from None
    return data, parse_record(kind, values, file, version=version, data=data)


def totals_of(table: PartTable) -> Totals:
    """The sums over the parts of a table."""
    return Totals(
        parts=len(table),
        episodes=table.total("episodes"),
        steps=table.total("steps"),
        bytes=table.total("size"),
    )


def write_dataset(
    folder: Path,
    *,
    label: str | None,
    data_version: int,
    runs: Sequence[Run],
    derivation: Derivation | None,
    platforms: Sequence[Platform],
    tasks: Sequence[Task],
    dropped: Collection[int] = (),
    table: PartTable,
) -> Manifest:
    """Writes the tables and then the manifest that seals them; the dataset exists from then on.

    The fields are those of `Manifest`; `tasks` and `table` hold those of dropped tasks too.
    """
    tables = {
        TASKS: b"".join(task_line(task) for task in sorted(tasks, key=lambda task: task.index)),
        PARTS_TABLE: HEADER + b"".join(map(part_line, table.entries())),
    }
    for file, lines in tables.items():
        replace_file(folder / file, lines, staging=folder / STAGING)
    data = manifest_bytes(
        label=label,
        data_version=data_version,
        runs=runs,
        derivation=derivation,
        platforms=platforms,
        tasks=seal_of(tables[TASKS]),
        parts=seal_of(tables[PARTS_TABLE]),
        dropped=dropped,
        kept=table.without_tasks(dropped),
    )
    write_manifest(folder, data)
    return read_manifest(folder)


def manifest_bytes(
    *,
    label: str | None,
    data_version: int,
    runs: Sequence[Run],
    derivation: Derivation | None,
    platforms: Sequence[Platform],
    tasks: TableSeal,
    parts: TableSeal,
    dropped: Collection[int],
    kept: PartTable,
) -> bytes:
    """The file of a manifest of the given fields; `kept` are the parts of the tasks that are not dropped."""
    assert runs[0].recipe is not None
    fields = {
        "schema_version": MANIFEST_SCHEMA,
        "name": runs[0].recipe.environment.name,
        "label": label,
        "data_version": data_version,
        "runs": [run.model_dump(mode="json") for run in runs],
        "derivation": None if derivation is None else derivation.model_dump(mode="json"),
        "platforms": [platform.model_dump(mode="json") for platform in platforms],
        "tasks": tasks.model_dump(),
        "parts": parts.model_dump(),
        "dropped": sorted(dropped),
        "totals": totals_of(kept).model_dump(),
        "root": kept.root,
        "complete": is_complete(kept, runs, num_tasks=tasks.lines - len(dropped)),
    }
    return sealed(fields)


def is_complete(table: PartTable, runs: Sequence[Run], *, num_tasks: int) -> bool:
    """Whether `num_tasks` tasks, whose parts the table holds, all have the snapshots that the runs plan."""
    return all(
        table.num_parts(run.name) == len(run.steps) * num_tasks for run in runs if run.steps is not None
    )
