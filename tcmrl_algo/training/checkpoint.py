"""Runs on disk: `run.json`, and checkpoints of safetensors and JSON that appear whole or not at all."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import safetensors.torch
from pydantic import Field
from safetensors import SafetensorError
from torch import Tensor

from tcmrl_algo.algorithms.core.problem import MomentsRecord
from tcmrl_algo.algorithms.core.settings import TrainingConfig
from tcmrl_data import CheckpointError, Dataset, is_url, open_dataset
from tcmrl_data.foundation.disk import make_folders, publish_folder, remove_abandoned, remove_tree
from tcmrl_data.foundation.records import Frozen, read_record, record_bytes, sha256, write_record

METRICS = "metrics.jsonl"
EVALUATIONS = "evaluations.jsonl"
"""In the folder of a run: a line for every logged step, and one of means for every evaluation."""

KEPT = 2
"""Newest checkpoints kept: the last one, and one to fall back on."""


class RunRecord(Frozen):
    """`run.json`: everything a run is a function of, beside the code.

    Attributes:
        root: the dataset's root, which its content determines.
        profile: whose training table was resolved.
        seed: of everything random.
        steps: how far to train.
        privileged: whether the method is a control that sees task parameters.
    """

    schema_version: Literal[1] = 1
    environment: str
    dataset: str
    root: str
    profile: str
    seed: int = Field(ge=0)
    steps: int = Field(ge=1)
    device: str
    config: TrainingConfig
    privileged: bool
    moments: MomentsRecord
    versions: dict[str, str]


class CheckpointRecord(Frozen):
    """`checkpoint.json`: the step, and the digest of the tensors beside it.

    No generator state is kept: randomness of every step is a function of the run's seed and the step.
    """

    schema_version: Literal[1] = 1
    step: int = Field(ge=0)
    sha256: str


@final
@dataclass(frozen=True)
class Checkpoint:
    """A published checkpoint."""

    folder: Path
    step: int

    def tensors(self) -> dict[str, Tensor]:
        """The tensors, on the CPU.

        Raises:
            CheckpointError: a file is missing or is not what `checkpoint.json` says.
        """
        record = read_record(CheckpointRecord, self.folder / "checkpoint.json")
        file = self.folder / "tensors.safetensors"
        try:
            content = file.read_bytes()
            if sha256(content) != record.sha256:
                raise CheckpointError(f"{file} is damaged; delete {self.folder} to fall back on an older one")
            return safetensors.torch.load(content)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"{file} cannot be read: {error}") from None


@final
@dataclass(frozen=True)
class Run:
    """A run's folder."""

    folder: Path
    record: RunRecord

    def checkpoints(self) -> list[Checkpoint]:
        """Published checkpoints, ascending by step."""
        folders = sorted(self.folder.glob("checkpoints/step_" + 9 * "[0-9]"))
        return [Checkpoint(folder, int(folder.name.removeprefix("step_"))) for folder in folders]

    def newest(self) -> Checkpoint:
        """The checkpoint of the highest step.

        Raises:
            CheckpointError: there is none.
        """
        found = self.checkpoints()
        if not found:
            raise CheckpointError(f"{self.folder} has no checkpoint; train it with `tcmrl train --resume`")
        return found[-1]

    def save(self, step: int, tensors: Mapping[str, Tensor]) -> None:
        """Publishes a checkpoint by one rename, then removes what is old or was never finished."""
        content = safetensors.torch.save({name: value.cpu().contiguous() for name, value in tensors.items()})
        record = CheckpointRecord(step=step, sha256=sha256(content))
        target = self.folder / "checkpoints" / f"step_{step:09d}"
        make_folders(target.parent)
        remove_tree(target)
        files = {"tensors.safetensors": content, "checkpoint.json": record_bytes(record)}
        publish_folder(self.folder, target, files, attempt=target.name)
        remove_abandoned(self.folder)  # by a run that was killed while it saved
        for checkpoint in self.checkpoints()[:-KEPT]:
            remove_tree(checkpoint.folder)

    def open_dataset(self, path: str | Path | None = None) -> Dataset:
        """The dataset that it was trained on.

        Args:
            path: where it lies now, if it has moved.

        Raises:
            CheckpointError: it is not where it was, or the path holds another one.
        """
        if path is None and not is_url(self.record.dataset) and not Path(self.record.dataset).exists():
            raise CheckpointError(
                f"the run in {self.folder} was trained on {self.record.dataset}, where nothing lies now; "
                "name the dataset's new place with --dataset"
            )
        dataset = open_dataset(path or self.record.dataset)
        self.check_dataset(dataset)
        return dataset

    def check_dataset(self, dataset: Dataset) -> None:
        """Refuses data that the run was not trained on.

        Raises:
            CheckpointError: another environment or another root.
        """
        if dataset.name != self.record.environment:
            raise CheckpointError(
                f"{dataset.path} holds {dataset.name!r}, the run in {self.folder} is of "
                f"{self.record.environment!r}; name the right one with --dataset"
            )
        if dataset.manifest.root != self.record.root:
            raise CheckpointError(
                f"{dataset.path} has root {dataset.manifest.root[:12]}, the run in {self.folder} was "
                f"trained on {self.record.root[:12]}; name that dataset with --dataset, or train anew"
            )


def open_run(folder: str | Path) -> Run:
    """A run that training made.

    Raises:
        CheckpointError: the folder is missing or its `run.json` is not what a run writes.
    """
    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise CheckpointError(f"{folder} is no run: it has no run.json; `tcmrl train` makes one")
    return Run(folder, read_record(RunRecord, folder / "run.json"))


def write_run(folder: Path, record: RunRecord) -> Run:
    """Writes `run.json`, replacing an older one at once."""
    write_record(folder / "run.json", record)
    return Run(folder, record)


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """sha256 over names, types and bytes of tensors, sorted by name."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].cpu().contiguous()
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        total.update(tensor.numpy().tobytes())
    return total.hexdigest()


def list_runs(root: str | Path) -> list[dict[str, Any]]:
    """The runs below a folder, sorted by path; unreadable ones with `error`.

    Returns:
        Rows of `path`, `algorithm`, `environment`, `seed`, `step` of the newest checkpoint (0 without one),
        `steps`, `dataset`, `root` of the dataset, `metrics`, the last value of each, and `evaluation`, the
        last one or None.
    """
    rows: list[dict[str, Any]] = []
    for file in sorted(Path(root).glob("**/run.json")):
        try:
            rows.append(_row(open_run(file.parent)))
        except CheckpointError as error:
            rows.append({"path": str(file.parent), "error": str(error)})
    return rows


def _row(run: Run) -> dict[str, Any]:
    record, checkpoints = run.record, run.checkpoints()
    metrics: dict[str, Any] = {}
    for line in _written(run.folder / METRICS):
        metrics |= line  # a watched return is in some lines alone
    metrics = {name: value for name, value in metrics.items() if name not in ("step", "stage")}
    return {
        "path": str(run.folder),
        "algorithm": record.config.settings.run.algorithm,
        "environment": record.environment,
        "seed": record.seed,
        "step": checkpoints[-1].step if checkpoints else 0,
        "steps": record.steps,
        "dataset": record.dataset,
        "root": record.root,
        "metrics": metrics,
        "evaluation": next(reversed(_written(run.folder / EVALUATIONS)), None),
    }


def _written(file: Path) -> list[dict[str, Any]]:
    """The whole lines of a file of JSON lines that a run appends to; none where it is missing."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    return [json.loads(line) for line in lines if line.endswith("}")]
