"""Metrics and evaluations as they come, in one place: a line of JSON and TensorBoard points."""

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import final

from torch.utils.tensorboard import SummaryWriter

EVALUATIONS = "evaluations.jsonl"


def log_evaluation(folder: Path, *, step: int, protocol: str, scores: Mapping[str, float | None]) -> None:
    """Appends mean scores of an evaluation to a run's `evaluations.jsonl`, and to its TensorBoard curves.

    A run that cannot be written to, such as one on a shared disk, is evaluated all the same.

    Args:
        folder: the run's.
        step: of the checkpoint that was evaluated.
        protocol: by which it was adapted.
        scores: by name; None where there is none.
    """
    with contextlib.suppress(OSError):
        with (folder / EVALUATIONS).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"step": step, "protocol": protocol, **scores}) + "\n")
        with SummaryWriter(str(folder / "tensorboard"), filename_suffix=f".{protocol}") as board:
            for name, value in scores.items():
                if value is not None:
                    board.add_scalar(f"return/{protocol}/{name}", value, step)


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

    def write(self, step: int, metrics: Mapping[str, float], *, stage: str) -> None:
        """Logs the metrics of a step of a stage."""
        self._stream.write(json.dumps({"step": step, "stage": stage, **metrics}) + "\n")
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
