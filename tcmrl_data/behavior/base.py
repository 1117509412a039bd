"""The public module for a behavior plug-in: base class of the sources of policies, and their checkpoints.

Checkpoints of behavior training stand in `.checkpoints/<unit>/` of a dataset until the unit is published. A
checkpoint is one safetensors file named by its sha256; its header holds counters and generator states as
JSON. Nothing is pickled. A checkpoint that is damaged or has another key is ignored, and training starts
again from the beginning. If a checkpoint cannot be written, training continues.

The names of snapshots and tasks are repeated here.
"""

import abc
import contextlib
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy.typing as npt
from pydantic import BaseModel

from tcmrl_data.behavior.snapshot import GaussianDescription, ScriptedDescription, Snapshot
from tcmrl_data.envs.base import Environment, ObservationView, Reward, Task
from tcmrl_data.foundation.canonical import canonical_json, parse_json, sha256
from tcmrl_data.foundation.disk import CHECKPOINTS, STAGING, named_errors, remove_tree, replace_file
from tcmrl_data.foundation.errors import StorageError
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.foundation.process import DeferredInterrupts

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
        missing: by index of each incomplete task, its first missing snapshot step. A checkpoint at this step
            or later is ignored, unless the task had failed by then.
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
        observation: the view that policies receive.
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
