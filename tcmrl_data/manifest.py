"""Records of parts and datasets: schema version, digests, and a reader that trusts nothing it reads."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from tcmrl_data.canonical import canonical_json, digest, parse_json, sha256
from tcmrl_data.errors import ManifestError
from tcmrl_data.recipe import Profile, Recipe, first_problem

SCHEMA_VERSION = 1
"""Raised when the meaning or the layout of a dataset's files changes."""

DATA_VERSION = 1
"""Raised by hand when the code's data change for the same recipe and seed."""

MANIFEST = "manifest.json"
SHA256 = r"^[0-9a-f]{64}$"
Record = TypeVar("Record", bound=BaseModel)


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class ArrayRecord(_Record):
    """dtype, shape and sha256 of an array's decoded bytes."""

    dtype: Literal["float32", "int64", "bool"]
    shape: tuple[int, ...]
    sha256: str = Field(pattern=SHA256)


class FileRecord(_Record):
    """Size in bytes and sha256 of a file as it lies on disk."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern=SHA256)


class Identity(_Record):
    """What makes a part this part; its digest is the part's id.

    Attributes:
        settings: the recipe's environment, behavior and rollouts.
        task: index of the task.
        parameters: its parameters.
        step: snapshot step.
        seed: root seed of the build; episode seeds are keyed by (environment, task, purpose, step, episode).
        policy: digest of the snapshot.
        arrays: decoded contents.
    """

    schema_version: int
    data_version: int
    settings: dict[str, Any]
    task: int = Field(ge=0)
    parameters: dict[str, Any]
    step: int = Field(ge=0)
    seed: int = Field(ge=0)
    policy: str = Field(pattern=SHA256)
    arrays: dict[str, ArrayRecord]


class Statistics(_Record):
    """Undiscounted returns over a part's episodes, and moments that merge over parts.

    Attributes:
        quantiles: at 0, 10, 25, 50, 75, 90, 100 percent.
        success_rate: share of episodes with a success at any step; null without a success signal.
        moments: array name to count, and per-column sums and sums of squares, in double precision.
    """

    episodes: int
    steps: int
    mean: float
    std: float
    min: float
    max: float
    quantiles: tuple[float, ...]
    success_rate: float | None
    moments: dict[str, dict[str, Any]]


class References(_Record):
    """Mean returns that results are held against, each over the recipe's number of episodes.

    Attributes:
        uniform: uniform actions.
        oracle: a controller that knows the task; null where none can be computed.
        scripted: the environment's noise-free expert; null where there is none.
    """

    uniform: float
    oracle: float | None
    scripted: float | None


class PartRecord(_Record):
    """`part.json`: identity, and beside it what may differ between two machines."""

    schema_version: int
    id: str = Field(pattern=SHA256)
    identity: Identity
    statistics: Statistics
    references: References
    files: dict[str, FileRecord]
    provenance: dict[str, Any]


class TaskRecord(_Record):
    """A task of the dataset."""

    index: int = Field(ge=0)
    split: Literal["train", "test"]
    parameters: dict[str, Any]


class PartEntry(_Record):
    """A part as the manifest knows it; its folder follows from task and step."""

    task: int = Field(ge=0)
    step: int = Field(ge=0)
    id: str = Field(pattern=SHA256)
    sha256: str = Field(pattern=SHA256)


class TaskReferences(References):
    """Reference scores of one task; `behavior` is the best snapshot's mean return."""

    behavior: float


class Manifest(_Record):
    """`manifest.json`: everything a dataset holds.

    Attributes:
        digest: sha256 of the canonical form of all other fields.
        root: sha256 over the sorted lines `task/step id`: equal data, equal root.
        seed: root seed of behavior training and rollouts.
        steps: snapshot steps of every task.
        complete: every task has every snapshot.
    """

    schema_version: int
    digest: str = Field(pattern=SHA256)
    name: str = Field(pattern=r"^[a-z0-9_/-]{1,64}$")
    data_version: int
    seed: int = Field(ge=0)
    recipe: Recipe
    steps: tuple[int, ...]
    tasks: tuple[TaskRecord, ...]
    parts: tuple[PartEntry, ...]
    root: str = Field(pattern=SHA256)
    complete: bool
    references: dict[str, TaskReferences]

    @property
    def profile(self) -> Profile:
        """The profile that the dataset was built with."""
        return self.recipe.profile

    @property
    def training(self) -> dict[Profile, dict[str, Any]]:
        """Training defaults per profile."""
        return self.recipe.training

    @field_validator("tasks")
    @classmethod
    def _tasks_are_sorted(cls, tasks: tuple[TaskRecord, ...]) -> tuple[TaskRecord, ...]:
        indices = [task.index for task in tasks]
        if indices != sorted(set(indices)):
            raise ValueError("tasks must be sorted by index, each once")
        return tasks

    @field_validator("parts")
    @classmethod
    def _parts_are_sorted(cls, parts: tuple[PartEntry, ...]) -> tuple[PartEntry, ...]:
        keys = [(part.task, part.step) for part in parts]
        if keys != sorted(set(keys)):
            raise ValueError("parts must be sorted by task and step, each once")
        return parts


def merkle_root(parts: Iterable[PartEntry]) -> str:
    """sha256 over the sorted lines `task/step id`."""
    lines = sorted(f"{part.task}/{part.step} {part.id}" for part in parts)
    return sha256("\n".join(lines).encode())


def seal(fields: dict[str, Any]) -> bytes:
    """The bytes of a manifest with the given fields: canonical JSON with its own digest."""
    return canonical_json(fields | {"digest": digest(fields)})


def part_folder(task: int, step: int) -> str:
    """Relative folder of a part."""
    return f"tasks/{task:05d}/snapshots/step_{step:07d}"


def read_manifest(path: Path) -> Manifest:
    """Reads and checks `manifest.json`, given the file or its dataset's folder.

    Raises:
        ManifestError: missing, truncated, edited, or of another schema version; names file and field.
    """
    file = path if path.name == MANIFEST else path / MANIFEST
    if not file.is_file() or file.is_symlink():
        raise ManifestError(
            f"{file} does not exist; build a dataset with `tcmrl-data build ENV --out {file.parent}`"
        )
    data = file.read_bytes()
    try:
        values = parse_json(data)
    except ValueError as error:
        raise ManifestError(f"{file}: not a manifest ({error}); build again or restore the file") from None
    manifest = _validated(Manifest, values, file)
    fields = {key: value for key, value in values.items() if key != "digest"}
    if seal(fields) != data:
        raise ManifestError(f"{file}: digest does not match its contents; the file was edited or damaged")
    if manifest.root != merkle_root(manifest.parts):
        raise ManifestError(f"{file}: root does not match the parts")
    return manifest


def read_part_record(file: Path) -> PartRecord:
    """Reads `part.json` and checks that its id is its identity's digest.

    Raises:
        ManifestError: names file and field.
    """
    try:
        values = parse_json(file.read_bytes())
    except (OSError, ValueError) as error:
        raise ManifestError(
            f"{file}: not a part record ({error}); delete its folder and build again"
        ) from None
    record = _validated(PartRecord, values, file)
    if record.id != digest(values["identity"]):
        raise ManifestError(
            f"{file}: id is not the digest of its identity; delete its folder and build again"
        )
    for name in record.files:
        if not re.fullmatch(r"[a-z0-9_]{1,64}(\.[a-z]{1,16})?(/c(/\d{1,9}){1,2}|/zarr\.json)?", name):
            raise ManifestError(f"{file}: files names {name[:80]!r}, which no part has")
    return record


def _validated(kind: type[Record], values: Any, file: Path) -> Record:
    version = values.get("schema_version") if isinstance(values, dict) else None
    if version != SCHEMA_VERSION:
        raise ManifestError(
            f"{file}: schema_version {version!r} is not {SCHEMA_VERSION}, which this version reads"
        )
    try:
        return kind.model_validate_json(canonical_json(values))
    except ValidationError as error:
        raise ManifestError(f"{file}: {first_problem(error)}") from None
