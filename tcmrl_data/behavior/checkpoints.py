"""Checkpoints of behavior training, in `.checkpoints/<unit>/` of a dataset until the unit is published.

A checkpoint is one safetensors file named by its sha256; its header holds counters and generator states as
JSON. Nothing is pickled. A checkpoint that is damaged or has another key is ignored, and training starts
from the beginning.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from tcmrl_data.foundation.canonical import canonical_json, parse_json, sha256
from tcmrl_data.foundation.disk import CHECKPOINTS, STAGING, remove_tree, replace_file

CHECKPOINT_SECONDS = 60.0
CHECKPOINT_SHARE = 0.05
"""Maximum share of the time for writing checkpoints."""


@dataclass(frozen=True)
class TrainingState:
    """State of a training.

    Attributes:
        values: JSON values; `steps` is the number of environment steps done.
        arrays: arrays by name.
    """

    values: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any]]


class CheckpointFolder:
    """The latest checkpoint of a unit's training.

    Args:
        dataset: folder of the dataset.
        unit: name of the subfolder.
        key: digest of everything that the training depends on; a checkpoint with another key is ignored.
        before: training step of the first missing snapshot; a checkpoint at this step or later is ignored.
        seconds: minimum time between two checkpoints; 0 for one at every opportunity.
    """

    def __init__(
        self, dataset: Path, unit: str, *, key: str, before: float, seconds: float = CHECKPOINT_SECONDS
    ) -> None:
        self._dataset, self._folder = dataset, dataset / CHECKPOINTS / unit
        self._key, self._before = key, before
        self._seconds, self._saved, self._cost = seconds, time.monotonic(), 0.0

    def is_due(self) -> bool:
        """Whether it is time for a checkpoint; slow checkpoints are written less often."""
        wait = max(self._seconds, self._cost / CHECKPOINT_SHARE) if self._seconds else 0.0
        return time.monotonic() - self._saved >= wait

    def save(self, checkpoint: TrainingState) -> None:
        """Writes a checkpoint and removes the previous one."""
        from safetensors.numpy import save

        began = time.monotonic()
        header = canonical_json({"key": self._key, "values": checkpoint.values}).decode()
        data = save(dict(checkpoint.arrays), metadata={"state": header})
        earlier = self._files()
        replace_file(self._folder / f"{sha256(data)}.safetensors", data, staging=self._dataset / STAGING)
        for file in earlier:
            file.unlink(missing_ok=True)  # the unit may run in two processes at the same time
        self._saved = time.monotonic()
        self._cost = self._saved - began

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
                if state["key"] == self._key and state["values"]["steps"] < self._before:
                    return TrainingState(state["values"], load(data))
            except (OSError, ValueError, KeyError, TypeError, SafetensorError):
                continue
        return None

    def clear(self) -> None:
        """Removes the checkpoint."""
        remove_tree(self._folder)

    def _files(self) -> list[Path]:
        return sorted(self._folder.glob("*.safetensors"))
