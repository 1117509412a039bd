"""The public module for a behavior plug-in: snapshots of policies, checkpoints, the class of sources.

A snapshot is `policy.json` and, for networks, `policy.safetensors` in its part's archive; nothing is pickled.

Checkpoints of behavior training stand in `.checkpoints/<unit>/` of a dataset until the unit is published. A
checkpoint is one safetensors file named by its sha256; its header holds counters and generator states as
JSON. A checkpoint that is damaged or has another key is ignored, and training starts again from the
beginning. If a checkpoint cannot be written, training continues.

The names of tasks and environments are repeated here.
"""

import abc
import contextlib
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol, final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from tcmrl_data.envs.base import Environment, Parameters, Reward, Task
from tcmrl_data.envs.rollout import Controller, FloatArray, ObservationView
from tcmrl_data.foundation.disk import CHECKPOINTS, STAGING, named_errors, remove_tree, replace_file
from tcmrl_data.foundation.errors import SnapshotError, StorageError, StoreError
from tcmrl_data.foundation.files import one_line, printable
from tcmrl_data.foundation.machine import DeferredInterrupts
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.foundation.records import canonical_json, digest, parse_json, sha256

if TYPE_CHECKING:
    import torch

LOG_STD_RANGE = (-20.0, 2.0)
"""Limits of the log standard deviation in Stable-Baselines3's SAC actor."""

DESCRIPTION_BYTES = 2**16
"""Maximum size of `policy.json`."""

HEADER_BYTES = 2**16
"""Maximum size of the header of `policy.safetensors`."""


class _Description(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    observation: ObservationView


class GaussianDescription(_Description):
    """A squashed Gaussian policy with ReLU layers; its weights are in the safetensors file."""

    kind: Literal["squashed_gaussian"] = "squashed_gaussian"
    observation_dim: int = Field(ge=1, le=2**16)
    action_dim: int = Field(ge=1, le=2**16)
    hidden: tuple[Annotated[int, Field(ge=1, le=2**16)], ...] = Field(max_length=16)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of all tensors, by name."""
        widths = (self.observation_dim, *self.hidden)
        layers = {f"hidden.{i}": (out, into) for i, (into, out) in enumerate(pairwise(widths))}
        layers |= dict.fromkeys(("mean", "log_std"), (self.action_dim, widths[-1]))
        return {f"{name}.weight": shape for name, shape in layers.items()} | {
            f"{name}.bias": shape[:1] for name, shape in layers.items()
        }


class ScriptedDescription(_Description):
    """The environment's expert with N(0, noise) added to actions."""

    kind: Literal["scripted"] = "scripted"
    noise: float = Field(ge=0, le=10, allow_inf_nan=False)


PolicyDescription = Annotated[GaussianDescription | ScriptedDescription, Field(discriminator="kind")]
_DESCRIPTION: TypeAdapter[GaussianDescription | ScriptedDescription] = TypeAdapter(PolicyDescription)


class ReadFile(Protocol):
    """Reads a file by its name."""

    def __call__(self, name: str, *, limit: int) -> bytes:
        """The content of a file of at most `limit` bytes."""


@dataclass(frozen=True)
class Snapshot:
    """A behavior policy of one task at one training step.

    Attributes:
        step: environment steps of training; for scripted policies the index of the noise level.
        tensors: float32 weights by name; empty for scripted policies.
    """

    step: int
    description: GaussianDescription | ScriptedDescription
    tensors: Mapping[str, npt.NDArray[np.float32]] = field(default_factory=dict)

    @classmethod
    def of_network(
        cls, step: int, observation: ObservationView, tensors: Mapping[str, npt.NDArray[np.float32]]
    ) -> "Snapshot":
        """A snapshot of a Gaussian policy with the sizes of its tensors."""
        biases = [name for name in tensors if name.startswith("hidden.") and name.endswith(".bias")]
        description = GaussianDescription(
            observation=observation,
            observation_dim=tensors["hidden.0.weight"].shape[1],
            action_dim=tensors["mean.bias"].size,
            hidden=tuple(tensors[f"hidden.{index}.bias"].size for index in range(len(biases))),
        )
        return cls(step, description, tensors)

    def digest(self) -> str:
        """The sha256 of the description and of the dtype, shape and bytes of every tensor."""
        tensors = {
            name: [str(array.dtype), list(array.shape), sha256(np.ascontiguousarray(array).data)]
            for name, array in self.tensors.items()
        }
        return digest({"policy": self.description.model_dump(mode="json"), "tensors": tensors})

    def controller(self, environment: Environment, parameters: Sequence[Parameters]) -> Controller:
        """The policy as a controller for lanes with the given tasks.

        Raises:
            SnapshotError: the policy is scripted and the environment has no expert.
        """
        if isinstance(self.description, GaussianDescription):
            return GaussianController(self.description, self.tensors)
        controller = environment.scripted(parameters, self.description.noise)
        if controller is None:
            raise SnapshotError(f"{environment.name} has no scripted policy; use --behavior sac")
        return controller

    def files(self) -> dict[str, bytes]:
        """The content of the policy's files, by name."""
        from safetensors.numpy import save

        files = {"policy.json": canonical_json(self.description.model_dump(mode="json"))}
        if self.tensors:
            files["policy.safetensors"] = save(dict(self.tensors))
        return files


def read_snapshot(read: ReadFile, step: int, *, place: str) -> Snapshot:
    """Reads a snapshot; error messages begin with `place`.

    Raises:
        SnapshotError: a file is missing or malformed, tensors do not have the names, shapes and dtypes of
            the description, or weights are not finite.
    """
    try:
        values = parse_json(read("policy.json", limit=DESCRIPTION_BYTES))
        description = _DESCRIPTION.validate_json(canonical_json(values))
    except (OSError, ValueError, StoreError) as error:
        raise SnapshotError(f"{place}: policy.json: not a policy description ({one_line(error)})") from None
    if isinstance(description, ScriptedDescription):
        return Snapshot(step, description)
    return Snapshot(step, description, _read_tensors(read, place, description.shapes()))


def _read_tensors(
    read: ReadFile, place: str, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, npt.NDArray[np.float32]]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    file = f"{place}: policy.safetensors"
    weights = sum(int(np.prod(shape)) for shape in shapes.values())
    try:
        data = read("policy.safetensors", limit=4 * weights + HEADER_BYTES)
        if len(data) < 4 * weights:
            raise SnapshotError(f"{file}: {len(data)} bytes, the policy needs {4 * weights}")
        tensors = load(data)
    except (OSError, ValueError, KeyError, TypeError, StoreError, SafetensorError) as error:
        raise SnapshotError(f"{file}: cannot be read as safetensors ({one_line(error)})") from None
    found = {name: array.shape for name, array in tensors.items()}
    if found != dict(shapes):
        names = printable(str(sorted(found)))[:200]
        raise SnapshotError(f"{file}: tensors {names} do not have the policy's names and shapes")
    for name, array in tensors.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise SnapshotError(f"{file}: tensor {name!r} must be finite float32")
    return tensors


@final
class GaussianController(Controller):
    """Acts by tanh(mean + std * noise), computed like Stable-Baselines3's SAC actor."""

    def __init__(
        self, description: GaussianDescription, tensors: Mapping[str, npt.NDArray[np.float32]]
    ) -> None:
        import torch

        self.view = description.observation
        self._hidden = range(len(description.hidden))
        self._tensors = {name: torch.tensor(array) for name, array in tensors.items()}

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        import torch

        with torch.inference_mode():
            features = torch.tensor(observations, dtype=torch.float32)
            for i in self._hidden:
                features = torch.relu(self._linear(f"hidden.{i}", features))
            mean = self._linear("mean", features)
            std = torch.clamp(self._linear("log_std", features), *LOG_STD_RANGE).exp()
            squashed = torch.tanh(mean + torch.from_numpy(noise) * std).numpy()
        # Stable-Baselines3 scales actions to [-1, 1]; here that can only change the last bit
        return -1.0 + 0.5 * (squashed + 1.0) * 2.0

    def _linear(self, name: str, features: "torch.Tensor") -> "torch.Tensor":
        from torch.nn.functional import linear

        return linear(features, self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"])


CHECKPOINT_SECONDS = 60.0
CHECKPOINT_SHARE = 0.05
"""Maximum share of the time that is spent on writing checkpoints."""


@dataclass(frozen=True)
class TrainingState:
    """State of a training.

    Attributes:
        values: JSON values. `steps` is the number of environment steps done. The optional `failed` maps the
            index (as text) of each task that failed to its first snapshot step that will never exist.
    """

    values: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any]]


class CheckpointFolder:
    """The latest checkpoint of a unit's training.

    Args:
        key: digest of everything that the training depends on.
        missing: the first missing snapshot step of every incomplete task, by task index. A training that
            continues from a checkpoint at this step or later would not make that snapshot again, so such a
            checkpoint is ignored. It is used, however, if it records that the task's training has failed at
            this step or before, because the snapshot will then never exist.
        seconds: minimum time between two checkpoints; 0 for as many as possible.
        warn: called once, with one line, when a checkpoint could not be written.
    """

    def __init__(
        self,
        dataset: Path,
        unit: str,
        *,
        key: str,
        missing: Mapping[int, int],
        seconds: float = CHECKPOINT_SECONDS,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        self._dataset, self._folder = dataset, dataset / CHECKPOINTS / unit
        self._key, self._missing, self._warn, self._has_warned = key, missing, warn, False
        self._seconds, self._saved, self._cost = seconds, time.monotonic(), 0.0
        self._interrupts = DeferredInterrupts()

    @contextlib.contextmanager
    def training(self) -> Iterator[None]:
        """Holds back signals that end the process until the next checkpoint, or until its block is left.

        Nothing may be yielded within the block: it is for the steps from one snapshot to the next.
        """
        with DeferredInterrupts() as self._interrupts:
            yield

    def is_due(self) -> bool:
        """Whether it is time for a checkpoint, or a signal waits for one; slow ones are less often due."""
        wait = max(self._seconds, self._cost / CHECKPOINT_SHARE) if self._seconds else 0.0
        return self._interrupts.checkpoint_wanted or time.monotonic() - self._saved >= wait

    def save(self, checkpoint: TrainingState) -> None:
        """Writes a checkpoint and removes the previous one; then a signal that waited takes effect.

        If the file cannot be written, the previous one stays and a warning is given.
        """
        began = time.monotonic()
        try:
            self._write(checkpoint)
        except StorageError as error:
            if self._warn is not None and not self._has_warned:
                self._warn(f"training goes on without a new checkpoint: {error}")
            self._has_warned = True
        self._saved = time.monotonic()
        self._cost = self._saved - began
        self._interrupts.checkpoint_written()
        if self._interrupts.received:
            self._interrupts.obey()

    def _write(self, checkpoint: TrainingState) -> None:
        from safetensors.numpy import save

        header = canonical_json({"key": self._key, "values": checkpoint.values}).decode()
        data = save(dict(checkpoint.arrays), metadata={"state": header})
        earlier = self._files()
        replace_file(self._folder / f"{sha256(data)}.safetensors", data, staging=self._dataset / STAGING)
        for file in earlier:
            with named_errors(file):
                file.unlink(missing_ok=True)  # the unit may run in two processes at the same time

    def load(self) -> TrainingState | None:
        """The latest valid checkpoint, or None."""
        from safetensors import SafetensorError
        from safetensors.numpy import load

        for file in self._files():
            try:
                data = file.read_bytes()
                if sha256(data) != file.stem:
                    continue
                header_bytes = int.from_bytes(data[:8], "little")
                state = parse_json(parse_json(data[8 : 8 + header_bytes])["__metadata__"]["state"].encode())
                if state["key"] == self._key and self._lacks_nothing(state["values"]):
                    return TrainingState(state["values"], load(data))
            except (OSError, ValueError, KeyError, TypeError, AttributeError, SafetensorError):
                continue
        return None

    def _lacks_nothing(self, values: Mapping[str, Any]) -> bool:
        """Whether a training that continues from here makes every missing snapshot that can be made."""
        failed = values.get("failed", {})
        return all(
            values["steps"] < step or failed.get(str(task), math.inf) <= step
            for task, step in self._missing.items()
        )

    def clear(self) -> None:
        """Removes the checkpoint."""
        remove_tree(self._folder)

    def _files(self) -> list[Path]:
        return sorted(self._folder.glob("*.safetensors"))


__all__ = [
    "BEHAVIOR_SOURCES",
    "BehaviorContext",
    "BehaviorSource",
    "CheckpointFolder",
    "Environment",
    "GaussianDescription",
    "ObservationView",
    "Reward",
    "ScriptedDescription",
    "Snapshot",
    "Task",
    "TrainingState",
]


_CHECKPOINT_NAME = re.compile(r"tasks?_([0-9]{5,10})(?:_([0-9]{5,10}))?")


def checkpoint_name(tasks: Sequence[Task]) -> str:
    """Name of the folder of a unit's checkpoints: its first and its last task, in ascending order."""
    first, last = tasks[0].index, tasks[-1].index
    return f"task_{first:05d}" if first == last else f"tasks_{first:05d}_{last:05d}"


def checkpoint_tasks(name: str) -> range | None:
    """The indices from the first to the last task of a checkpoint folder; None if it is none.

    The tasks between the two may be tasks of the unit or not built at all.
    """
    match = _CHECKPOINT_NAME.fullmatch(name)
    return range(int(match[1]), int(match[2] or match[1]) + 1) if match else None


@dataclass(frozen=True)
class BehaviorContext:
    """What a source receives to make the policies of a unit, the tasks that are trained together.

    Attributes:
        reward: the reward that they are trained on.
        report: called with the number of environment steps since the last call.
        checkpoints: returns the checkpoint folder for a training of some tasks.
    """

    environment: Environment
    tasks: Sequence[Task]
    seed: int
    observation: ObservationView
    reward: Reward
    report: Callable[[int], None]
    checkpoints: Callable[[Sequence[Task]], CheckpointFolder]


class BehaviorSource(abc.ABC):
    """Makes the behavior policies of tasks; a plug-in of the entry point group `tcmrl.behavior`."""

    name: ClassVar[str]
    Settings: ClassVar[type[BaseModel]]
    """Class of the recipe's `[behavior.<name>]` table."""
    extends: ClassVar[str | None] = None
    """Name of the source whose table gives the defaults of `[behavior.<name>]`."""

    def __init__(self, settings: BaseModel) -> None:
        self.settings = settings

    @property
    @abc.abstractmethod
    def steps(self) -> tuple[int, ...]:
        """The snapshot steps, in ascending order."""

    @property
    @abc.abstractmethod
    def training_steps(self) -> int:
        """Environment steps of behavior training per task."""

    @property
    def group_size(self) -> int:
        """Task indices per unit: tasks with the same `index // group_size` are trained together."""
        return 1

    @property
    def warmup_steps(self) -> int:
        """Environment steps of a task before its first update."""
        return 0

    def with_warmup(self, steps: int) -> "BehaviorSource":
        """This source with at most `steps` warm-up steps, for estimates that measure the time of updates."""
        return self

    @abc.abstractmethod
    def training_bytes(self, environment: Environment, num_tasks: int) -> int:
        """Maximum memory in bytes for training `num_tasks` tasks, without the process and the simulators."""

    def provenance(self) -> Mapping[str, Any]:
        """Further JSON values to record in the provenance of every part."""
        return {}

    @abc.abstractmethod
    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        """Yields (task, snapshot) for all snapshots of the unit, in ascending order of steps per task."""


BEHAVIOR_SOURCES = Registry("tcmrl.behavior", "behavior source", BehaviorSource)
