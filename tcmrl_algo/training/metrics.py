"""Metrics as they come, in one place: a line of JSON and a TensorBoard point per logged step."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import final

from torch.utils.tensorboard import SummaryWriter


@final
class MetricsWriter:
    """Appends to `metrics.jsonl` and `tensorboard/` in a run's folder.

    Args:
        folder: the run's.
        step: the checkpoint's step that training goes on from; what a killed run logged beyond it is dropped.
    """

    def __init__(self, folder: Path, *, step: int) -> None:
        self._file = folder / "metrics.jsonl"
        self._keep_until(step)
        self._stream = self._file.open("a", encoding="utf-8")
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Logs the metrics of a step."""
        self._stream.write(json.dumps({"step": step, **metrics}) + "\n")
        self._stream.flush()
        for name, value in metrics.items():
            self._board.add_scalar(name, value, step)

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()
        self._board.close()

    def _keep_until(self, step: int) -> None:
        if not self._file.is_file():
            return
        lines = self._file.read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
        self._file.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
