"""The record of a part, `part.json` in its archive: its identity, what it holds, and where it was made."""

import functools
import os
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from math import prod
from typing import Any, Literal, final

import numpy as np
from pydantic import Field, field_validator

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES
from tcmrl_data.envs.base import ENVIRONMENTS, Environment
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.files import one_line, printable
from tcmrl_data.foundation.machine import processor
from tcmrl_data.foundation.records import Record, digest, parse_json, parse_record
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import ARRAYS, ArrayLayout, check_expansion, check_layout
from tcmrl_data.store.tables import MAX_ARRAYS, MAX_COUNT, MAX_INDEX, PART_RECORD_BYTES, SHA256

PACKAGES = ("numpy", "torch", "stable-baselines3", "gymnasium", "mujoco", "metaworld")
"""Packages that compute numbers. `tcmrl` is not among them, the data version stands for it; nor is Zarr."""

VARIABLES = (
    "DNNL_MAX_CPU_ISA",
    "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS",
    "ONEDNN_MAX_CPU_ISA",
    "OPENBLAS_CORETYPE",
)
"""Environment variables that choose the code of libraries which do not report their choice."""

TEXT_LENGTH = 200


@final
class Platform(Record):
    """What shapes numbers on a machine; builds on equal platforms give equal bits.

    Attributes:
        cpu: model name of the processor.
        system: architecture, operating system and C library.
        python: version of Python.
        instructions: instruction sets that NumPy and torch use, which variables may restrict.
        variables: values of VARIABLES, those that are set.
        packages: versions of PACKAGES, and of the packages that provide the environment and the source.
        physics: the environment's fingerprint.
    """

    cpu: str
    system: str
    python: str
    instructions: dict[str, str]
    variables: dict[str, str]
    packages: dict[str, str]
    physics: dict[str, Any]

    def digest(self) -> str:
        """The digest of the platform; equal platforms have equal digests."""
        return digest(self.model_dump(mode="json"))

    def differences(self, other: "Platform") -> list[str]:
        """What differs, such as `torch 2.13.0 there, 2.14.0 here`, sorted; empty for equal platforms.

        `here` is this platform, `there` is the other one.
        """
        here, there = dict(_values(self)), dict(_values(other))
        return [
            f"{name} {there.get(name, 'unset')} there, {here.get(name, 'unset')} here"
            for name in sorted({*here, *there})
            if here.get(name) != there.get(name)
        ]


UNKNOWN = Platform(
    cpu="unknown",
    system="unknown",
    python="unknown",
    instructions={},
    variables={},
    packages={},
    physics={},
)
"""The platform of a part whose source does not name one; it equals no real platform."""


def this_platform(environment: Environment, behavior: str | None = None) -> Platform:
    """The platform of this process.

    Making the environment's fingerprint loads a simulator, so a process should call this once.

    Args:
        behavior: name of the behavior source; its package counts too.
    """
    return Platform(
        **_machine(), packages=_packages(environment, behavior), physics=environment.fingerprint()
    )


@functools.cache
def _machine() -> dict[str, Any]:
    import torch

    libc = " ".join(filter(None, platform.libc_ver()))
    return {
        "cpu": _text(processor()),
        "system": _text(f"{platform.machine()} {platform.system()}, {libc or 'unknown C library'}"),
        "python": platform.python_version(),
        "instructions": {
            "numpy": " ".join(_numpy_instructions()),
            "torch": torch.backends.cpu.get_cpu_capability(),
        },
        "variables": {name: _text(os.environ[name]) for name in VARIABLES if name in os.environ},
    }


def _numpy_instructions() -> list[str]:
    """Names of the instruction sets that NumPy was built for, or has found and uses."""
    found: Any = np.show_config(mode="dicts")
    sets = found.get("SIMD Extensions", {})
    return [*sets.get("baseline", []), *sets.get("found", [])]


def _packages(environment: Environment, behavior: str | None) -> dict[str, str]:
    providers = [ENVIRONMENTS.provider(environment.name.partition("/")[0])]
    providers += [BEHAVIOR_SOURCES.provider(behavior)] if behavior else []
    foreign = {name for name in providers if name not in (None, "tcmrl")}
    return {name: _text(version(name)) for name in sorted({*PACKAGES, *foreign})}


def _text(value: str) -> str:
    return printable(value)[:TEXT_LENGTH]


def _values(found: Platform) -> Iterator[tuple[str, str]]:
    """Names and values of all that a platform consists of; a version has its package's name, once."""
    yield from (("cpu", found.cpu), ("system", found.system), ("python", found.python))
    yield from ((f"instruction sets of {name}", value) for name, value in found.instructions.items())
    yield from found.variables.items()
    yield from found.packages.items()
    for name, value in found.physics.items():
        if name != "versions" or not isinstance(value, Mapping):
            yield f"physics.{name}", str(value)
        elif any(found.packages.get(package) != number for package, number in value.items()):
            yield "physics.versions", ", ".join(f"{package} {value[package]}" for package in sorted(value))


PART_SCHEMA = 2
"""Raised when the meaning or the layout of a part's files changes; no part of the identity."""

DATA_VERSION = 3
"""Raised by hand when the code's data change for the same recipe and seed."""

RECORD = "part.json"

STANDARD_ARRAYS = {
    "observations": ("float32", 2),
    "actions": ("float32", 2),
    "rewards": ("float32", 1),
    "terminated": ("bool", 1),
    "truncated": ("bool", 1),
    "episode_offsets": ("int64", 1),
}
"""dtype and rank of the arrays of every part; an environment's extra arrays have rank 1."""

ARRAY_NAME = r"[a-z0-9_]{1,64}"


class ArrayRecord(Record):
    """dtype, shape and sha256 of an array's decoded bytes."""

    dtype: Literal["float32", "int64", "bool"]
    shape: tuple[int, ...]
    sha256: str = Field(pattern=SHA256)


class Identity(Record):
    """What makes a part this part; its digest is the part's id.

    The name of the run is not in it: a part keeps its id and its bytes in whichever dataset it lies.

    Attributes:
        settings: the recipe's environment, behavior and rollouts.
        task: index of the task.
        parameters: its parameters.
        step: snapshot step.
        seed: root seed of the build; episode seeds are keyed by (environment, task, purpose, step, episode).
            Null where it is not known.
        policy: digest of the snapshot; null where the part holds none.
        arrays: decoded contents.
        derived: how the part was made from other parts; null for rollouts of its own policy.
    """

    data_version: int
    settings: dict[str, Any]
    task: int = Field(ge=0, lt=MAX_INDEX)
    parameters: dict[str, Any]
    step: int = Field(ge=0, lt=MAX_INDEX)
    seed: int | None = Field(ge=0)
    policy: str | None = Field(pattern=SHA256)
    arrays: dict[str, ArrayRecord] = Field(max_length=MAX_ARRAYS)
    derived: dict[str, Any] | None = None

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
            if not re.fullmatch(ARRAY_NAME, name):
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

    episodes: int = Field(ge=0, lt=MAX_COUNT)
    steps: int = Field(ge=0, lt=MAX_COUNT)
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
        uniform: uniform actions; null where it was not measured.
        oracle: a controller that knows the task; null where none can be computed.
        scripted: the environment's noise-free expert; null where there is none.
    """

    uniform: float | None
    oracle: float | None
    scripted: float | None


class PartRecord(Record):
    """`part.json`.

    Attributes:
        id: digest of the identity.
        behavior: what the behavior source records with its parts.
        platform: what the part was made on; parts made on equal platforms are equal byte for byte.
    """

    schema_version: int
    id: str = Field(pattern=SHA256)
    identity: Identity
    statistics: Statistics
    references: References
    behavior: dict[str, Any]
    platform: Platform


def read_part_record(archive: Archive) -> PartRecord:
    """Reads `part.json` of a part and checks that its id is its identity's digest."""
    place = archive.place(RECORD)
    try:
        values = parse_json(archive.read(RECORD, limit=PART_RECORD_BYTES))
    except ValueError as error:
        raise ManifestError(
            f"{place}: not a part record ({one_line(error)}); run `tcmrl-data verify --repair`"
        ) from None
    if _num_arrays(values) > MAX_ARRAYS:  # an error about each would take much memory
        raise ManifestError(f"{place}: identity.arrays names more than {MAX_ARRAYS} arrays")
    record = parse_record(PartRecord, values, place, version=PART_SCHEMA)
    if record.id != digest(values["identity"]):
        raise ManifestError(
            f"{place}: id is not the digest of its identity; run `tcmrl-data verify --repair`"
        )
    return record


def _num_arrays(values: Any) -> int:
    identity = values.get("identity") if isinstance(values, dict) else None
    arrays = identity.get("arrays") if isinstance(identity, dict) else None
    return len(arrays) if isinstance(arrays, dict) else 0


POLICY = ("policy.json", "policy.safetensors")
"""The snapshot; the second file is missing where the policy has no weights."""


def check_members(archive: Archive, record: PartRecord) -> list[ArrayLayout]:
    """Checks that an archive holds the files of its record's arrays and policy and no others.

    Returns:
        The layouts of the arrays.
    """
    layouts = check_layout(
        archive, {name: array.model_dump() for name, array in record.identity.arrays.items()}
    )
    odd = _odd_member(archive, layouts, has_policy=record.identity.policy is not None)
    if odd:
        raise StoreError(
            f"{archive.place(odd)} does not agree with the arrays; run `tcmrl-data verify --repair`"
        )
    check_expansion(layouts, archive.size, archive.path)
    return layouts


def _odd_member(archive: Archive, layouts: Sequence[ArrayLayout], *, has_policy: bool) -> str | None:
    """A file that the part's record calls for and its archive lacks, or the other way round."""
    found = set(archive.names)
    for layout in layouts:
        if prod(layout.grid) > len(found):
            return f"{ARRAYS}/{layout.name}/c"
    needed = {f"{ARRAYS}/zarr.json", RECORD}.union(*(layout.files() for layout in layouts))
    needed |= {POLICY[0]} if has_policy else set()
    return min((needed ^ found) - ({POLICY[1]} if has_policy else set()), default=None)
