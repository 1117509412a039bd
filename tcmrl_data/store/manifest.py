"""Records of parts and datasets: schema version, digests, and a reader that trusts nothing it reads."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import FailFast, Field, field_validator, model_validator

from tcmrl_data.foundation.canonical import MAX_JSON_BYTES, canonical_json, digest, parse_json, sha256
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.plain_files import one_line, read_plain_file
from tcmrl_data.foundation.records import Record, parse_record
from tcmrl_data.recipe.profile import Profile
from tcmrl_data.recipe.recipe import Recipe

SCHEMA_VERSION = 1
"""Raised when the meaning or the layout of a dataset's files changes."""

DATA_VERSION = 2
"""Raised by hand when the code's data change for the same recipe and seed."""

MANIFEST = "manifest.json"
PART_RECORD_BYTES = 2**18
MAX_TASKS = 2_000
SHA256 = r"^[0-9a-f]{64}$"
MAX_INDEX = 2**31  # task indices and steps become folder names

STANDARD_ARRAYS = {
    "observations": ("float32", 2),
    "actions": ("float32", 2),
    "rewards": ("float32", 1),
    "terminated": ("bool", 1),
    "truncated": ("bool", 1),
    "episode_offsets": ("int64", 1),
}
"""dtype and rank of the arrays of every part; an environment's extra arrays have rank 1."""

MAX_ARRAYS = 32
_ARRAY_NAME = r"[a-z0-9_]{1,64}"
_FILE_NAME = rf"policy\.(json|safetensors)|zarr\.json|{_ARRAY_NAME}/(zarr\.json|c(/[0-9]{{1,9}}){{1,2}})"


class ArrayRecord(Record):
    """dtype, shape and sha256 of an array's decoded bytes."""

    dtype: Literal["float32", "int64", "bool"]
    shape: tuple[int, ...]
    sha256: str = Field(pattern=SHA256)


class FileRecord(Record):
    """Size in bytes and sha256 of a file as it lies on disk."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern=SHA256)


class Identity(Record):
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
    task: int = Field(ge=0, lt=MAX_INDEX)
    parameters: dict[str, Any]
    step: int = Field(ge=0, lt=MAX_INDEX)
    seed: int = Field(ge=0)
    policy: str = Field(pattern=SHA256)
    arrays: dict[str, ArrayRecord] = Field(max_length=MAX_ARRAYS)

    @field_validator("arrays")
    @classmethod
    def _arrays_form_episodes(cls, arrays: dict[str, ArrayRecord]) -> dict[str, ArrayRecord]:
        for name, (dtype, rank) in STANDARD_ARRAYS.items():
            if name not in arrays:
                raise ValueError(f"{name} is missing")
            if (arrays[name].dtype, len(arrays[name].shape)) != (dtype, rank):
                raise ValueError(f"{name} must be {dtype} of rank {rank}")
        steps, episodes = arrays["actions"].shape[0], arrays["episode_offsets"].shape[0] - 1
        rows = {"observations": steps + episodes, "episode_offsets": episodes + 1}
        for name, record in arrays.items():
            if not re.fullmatch(_ARRAY_NAME, name):
                raise ValueError(f"{name[:80]!r} is no array name")
            if name not in STANDARD_ARRAYS and len(record.shape) != 1:
                raise ValueError(f"{name} must be of rank 1")
            if record.shape[0] != rows.get(name, steps) or episodes < 1 or min(record.shape) < 0:
                raise ValueError(f"{name}: shape {list(record.shape)} does not fit {steps} steps")
        return arrays


class Statistics(Record):
    """Undiscounted returns over a part's episodes, and moments that merge over parts.

    Attributes:
        quantiles: at 0, 10, 25, 50, 75, 90, 100 percent.
        success_rate: share of episodes with a success at any step; null without a success signal.
        moments: array name to count, and per-column sums and sums of squares, in double precision.
    """

    episodes: int = Field(ge=0, lt=2**40)
    steps: int = Field(ge=0, lt=2**40)
    mean: float
    std: float
    min: float
    max: float
    quantiles: tuple[float, ...]
    success_rate: float | None
    moments: dict[str, dict[str, Any]]


class References(Record):
    """Mean returns to compare results with, over the recipe's number of episodes.

    Attributes:
        uniform: uniform actions.
        oracle: a controller that knows the task; null where none can be computed.
        scripted: the environment's noise-free expert; null where there is none.
    """

    uniform: float
    oracle: float | None
    scripted: float | None


class PartRecord(Record):
    """`part.json`: identity, and beside it what may differ between two machines."""

    schema_version: int
    id: str = Field(pattern=SHA256)
    identity: Identity
    statistics: Statistics
    references: References
    files: dict[str, FileRecord]
    provenance: dict[str, Any]


class TaskRecord(Record):
    """A task of the dataset."""

    index: int = Field(ge=0, lt=MAX_INDEX)
    split: Literal["train", "test"]
    parameters: dict[str, Any]


class PartEntry(Record):
    """A part as the manifest knows it; its folder follows from task and step."""

    task: int = Field(ge=0, lt=MAX_INDEX)
    step: int = Field(ge=0, lt=MAX_INDEX)
    id: str = Field(pattern=SHA256)
    sha256: str = Field(pattern=SHA256)


class TaskReferences(References):
    """Reference scores of one task; `behavior` is the best snapshot's mean return."""

    behavior: float


class Manifest(Record):
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
    tasks: Annotated[tuple[TaskRecord, ...], FailFast()]
    parts: Annotated[tuple[PartEntry, ...], FailFast()]
    root: str = Field(pattern=SHA256)
    complete: bool
    references: dict[str, TaskReferences] = Field(max_length=MAX_TASKS)

    @property
    def profile(self) -> Profile:
        """The profile that the dataset was built with."""
        return self.recipe.profile

    @property
    def training(self) -> dict[Profile, dict[str, Any]]:
        """Training defaults per profile."""
        return self.recipe.training

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> "Manifest":
        indices, keys = [task.index for task in self.tasks], [(part.task, part.step) for part in self.parts]
        if indices != sorted(set(indices)) or list(self.steps) != sorted(set(self.steps)):
            raise ValueError("tasks and steps must be sorted, each once")
        if keys != sorted(set(keys)):
            raise ValueError("parts must be sorted by task and step, each once")
        if self.recipe.environment.name != self.name:
            raise ValueError("recipe.environment.name is not the manifest's name")
        tasks, steps = set(indices), set(self.steps)
        if self.root != merkle_root(self.parts):
            raise ValueError("root does not match the parts")
        if any(task not in tasks or step not in steps for task, step in keys):
            raise ValueError("parts names a task or step that the dataset does not have")
        if self.complete != (len(keys) == len(tasks) * len(steps)):
            raise ValueError("complete does not agree with the parts")
        if not set(self.references) <= set(map(str, tasks)):
            raise ValueError("references names a task that the dataset does not have")
        return self


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


def dataset_folder(path: str | Path) -> Path:
    """The folder of a dataset, given the folder or its `manifest.json`."""
    path = Path(path)
    return path.parent if path.name == MANIFEST else path


def read_manifest(path: Path) -> Manifest:
    """Reads and checks `manifest.json`, given the file or its dataset's folder.

    Raises:
        ManifestError: missing, truncated, edited, or of another schema version; names file and field.
    """
    file = dataset_folder(path) / MANIFEST
    try:
        data = read_plain_file(file, limit=MAX_JSON_BYTES)
        values = parse_json(data)
    except (FileNotFoundError, NotADirectoryError):
        raise ManifestError(
            f"{file} does not exist; build a dataset with `tcmrl-data build ENV --out {file.parent}`"
        ) from None
    except (OSError, ValueError) as error:
        raise ManifestError(
            f"{file}: not a manifest ({one_line(error)}); build again or restore the file"
        ) from None
    manifest = parse_record(Manifest, values, file, version=SCHEMA_VERSION)
    fields = {key: value for key, value in values.items() if key != "digest"}
    if seal(fields) != data:
        raise ManifestError(f"{file}: digest does not match its contents; the file was edited or damaged")
    return manifest


def read_part_record(file: Path) -> PartRecord:
    """Reads `part.json` and checks that its id is its identity's digest.

    Raises:
        ManifestError: names file and field.
    """
    return read_sealed_part(file)[0]


def read_sealed_part(file: Path) -> tuple[PartRecord, str]:
    """A part's record and the sha256 of the very bytes that it was read from.

    Raises:
        ManifestError: names file and field.
    """
    try:
        data = read_plain_file(file, limit=PART_RECORD_BYTES)
        values = parse_json(data)
    except FileNotFoundError:
        raise ManifestError(f"{file} is missing; run `tcmrl-data repair`") from None
    except (OSError, ValueError) as error:
        raise ManifestError(
            f"{file}: not a part record ({one_line(error)}); run `tcmrl-data repair`"
        ) from None
    record = parse_record(PartRecord, values, file, version=SCHEMA_VERSION)
    if record.id != digest(values["identity"]):
        raise ManifestError(f"{file}: id is not the digest of its identity; run `tcmrl-data repair`")
    for name in record.files:
        if not re.fullmatch(_FILE_NAME, name):
            raise ManifestError(f"{file}: files names {name[:80]!r}, which no part has")
    return record, sha256(data)
