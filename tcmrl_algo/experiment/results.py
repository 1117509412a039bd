"""The record of a run: what a worker is told, what a run leaves, and its rows as CSV.

`RunSpec` says which run it is; a `Job` adds what a worker needs to do it, a `RunResult` what came of it.
"""

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from tcmrl_algo.algorithms.core.settings import TrainingConfig
from tcmrl_algo.experiment.spec import Experiment, run_id
from tcmrl_data import CheckpointError
from tcmrl_data.foundation.disk import make_folders, replace_file
from tcmrl_data.foundation.records import Frozen, read_record

COLUMNS = (
    "environment",
    "method",
    "algorithm",
    "privileged",
    "seed",
    "fold",
    "protocol",
    "final",
    "regret",
    "normalized",
    "shuffled",
    "success",
    "steps",
    "training_seconds",
    "evaluation_seconds",
    "peak_memory",
    "root",
    "digest",
)
AGAIN = "; delete it, and the run is done again"
"""What helps against a broken result."""
GONE = frozenset({"shared", "training_of"})
"""What records of earlier versions say of trainings that runs shared."""
DIVERGED = "diverged"
"""Instead of a digest, where training diverged; the run's `error.txt` says how."""
DIGITS = 6
"""Significant digits of a float in a table of results; reports print four."""
YES = "yes"
Row = TypeVar("Row")


class CurvePoint(Frozen):
    """One point of a learning curve, and what it took to get there.

    Attributes:
        final, regret, normalized, shuffled: means over test tasks under the experiment's first protocol; of
            one repeat of it except at the last point, so that evaluation does not outlast training.
        timed_steps, seconds: of training since the last point, as far as this process did it.
        evaluation_seconds: of all evaluation at this point.
        peak_memory: bytes, of the process, so far.
        device_memory: bytes, of tensors on a CUDA device, so far; 0 on the CPU.
    """

    step: int
    stage: str = "train"
    final: float
    regret: float | None
    normalized: float | None
    shuffled: float
    timed_steps: int
    seconds: float
    evaluation_seconds: float
    peak_memory: int
    device_memory: int


class Tuned(Frozen):
    """The best settings of a tuning, and what it took to find them.

    Attributes:
        environment, root, profile: what the method was tuned on, from whose training table.
        trials, steps, seeds: how many trials, of how many training steps, with which seeds each.
        score: of the best trial: a mean normalised return on held-out training tasks.
        overrides: its settings, as `section.key=value` texts.
    """

    environment: str
    root: str
    profile: str
    trials: int
    steps: int
    seeds: tuple[int, ...]
    score: float
    overrides: tuple[str, ...]


TunedSettings = Mapping[str, Mapping[str, Tuned]]
"""Tuned settings by environment and algorithm."""


class ContextMeasures(Frozen):
    """What a report measures of a run's contexts and attention; it needs the checkpoint and the dataset.

    Attributes:
        tasks: number of tasks with stored trajectories that were encoded.
        context_ratio: mean distance between contexts of one task over that between contexts of two tasks;
            None for a method without contexts.
        centroid_accuracy: share of the contexts that are nearest to the mean context of their own task.
        attention_zero, attention_nonzero: mean attention to transitions without and with reward, where
            uniform attention is 1; None for a method without attention, or without both kinds.
        median_zero, median_nonzero: medians of the same.
    """

    tasks: int
    context_ratio: float | None = None
    centroid_accuracy: float | None = None
    attention_zero: float | None = None
    attention_nonzero: float | None = None
    median_zero: float | None = None
    median_nonzero: float | None = None


class Curve(Frozen):
    """`curve.json` in a run's folder: the points so far."""

    points: tuple[CurvePoint, ...] = ()


class RunSpec(Frozen):
    """Which run: a method on a dataset with a seed, and all settings.

    Attributes:
        experiment, method, environment, seed, profile: which run this is, from whose training table.
        fold: which fold of the tasks is its test split, in an experiment with folds.
        dataset, root: the dataset, by an absolute path, and its Merkle root.
        identity: everything that the result is a function of, beside code, device and threads.
        tuned: where its settings come from, if they were tuned.
    """

    experiment: str
    method: str
    environment: str
    seed: int
    fold: int | None = None
    profile: str
    dataset: str
    root: str
    device: str
    identity: dict[str, Any]
    config: TrainingConfig
    tuned: Tuned | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_gone(cls, document: Any) -> Any:
        if not isinstance(document, dict):
            return document
        return {key: value for key, value in document.items() if key not in GONE}

    @property
    def id(self) -> str:
        """Names the run's files in a results folder."""
        return run_id(self.environment, self.method, self.seed, self.fold)

    @property
    def pair(self) -> tuple[int, int | None]:
        """Seed and fold, by which runs of two methods are compared."""
        return self.seed, self.fold


class Job(RunSpec):
    """A run to do: what its worker is told, and `job.json` in its folder.

    Attributes:
        folder: the run's, absolute; the result is written beside it.
        protocols, curve_points: how it is evaluated.
    """

    folder: str
    protocols: tuple[str, ...]
    curve_points: int

    def points(self) -> list[int]:
        """Steps at which the learning curve is evaluated; the last one is the end of training."""
        steps = self.config.settings.run.steps
        return [round(steps * (index + 1) / self.curve_points) for index in range(self.curve_points)]


class RunResult(RunSpec):
    """A finished run: what it learned, and what it took.

    Attributes:
        folder: of the run, with its checkpoints; it may be gone. Not part of the document.
        algorithm, privileged: the method in code; whether it is a control that sees task parameters.
        steps, threads: of training; results depend on threads and device in their last bits.
        evaluations: by protocol, the documents of `tcmrl evaluate --json`.
        training_seconds: of training alone, scaled up to all steps where a killed process did some of
            them; None where none was timed.
        peak_memory: bytes, of the process, or of the CUDA device where there is one.
        contexts: what a report measured of its contexts; None before, and without a checkpoint.
        behavior_seed: root seed of the dataset; None where none is known.
        commit: of this package's code, with `-dirty` where files were changed since; None where the code was
            no git checkout.
        processor: model name of what trained, a processor or a graphics card.
    """

    schema_version: Literal[1] = 1
    folder: Path | None = Field(default=None, exclude=True)
    algorithm: str
    privileged: bool
    steps: int
    threads: int
    versions: dict[str, str]
    digest: str
    curve: tuple[CurvePoint, ...]
    evaluations: dict[str, dict[str, Any]]
    training_seconds: float | None
    evaluation_seconds: float | None
    peak_memory: int | None
    contexts: ContextMeasures | None = None
    behavior_seed: int | None = None
    commit: str | None = None
    processor: str | None = None

    @property
    def label(self) -> str:
        """Name of the method in tables and figures, which marks a control that observes task parameters."""
        return f"{self.method} (privileged)" if self.privileged else self.method

    def rows(self) -> list[dict[str, Any]]:
        """Rows of `table.csv`, one per protocol."""
        shared = self.model_dump(include=set(COLUMNS))
        return [
            shared
            | {"protocol": protocol}
            | {name: evaluation[f"mean_{name}"] for name in ("final", "regret", "normalized", "shuffled")}
            | {"success": success_rate(evaluation)}
            for protocol, evaluation in self.evaluations.items()
        ]


def success_rate(evaluation: Mapping[str, Any]) -> float | None:
    """Share of successful final episodes, mean over test tasks; None where the environment has no success."""
    shares = [task.get("success") for task in evaluation["tasks"]]
    return None if None in shares or not shares else sum(shares) / len(shares)


def table_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = COLUMNS) -> str:
    """Rows as CSV; None becomes an empty field."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def result_file(folder: Path) -> Path:
    """Where the result of the run in a folder is written, as its last deed."""
    return folder.with_name(f"{folder.name}.json")


def error_file(folder: Path) -> Path:
    """Where it is said why the run in a folder failed, until it is tried again."""
    return folder / "error.txt"


def read_result(folder: Path) -> RunResult:
    """The result of the run in a folder.

    Raises:
        CheckpointError: there is none, or it is not what a run writes.
    """
    result = read_record(RunResult, result_file(folder), remedy=AGAIN)
    return result.model_copy(update={"folder": folder})


def read_results(folder: Path, experiment: Experiment) -> list[RunResult]:
    """Every finished run in a results folder, by environment, method (in the file's order), fold and seed.

    Raises:
        CheckpointError: a result is not what a run writes.
    """
    order = list(experiment.methods)
    results = [read_result(file.with_suffix("")) for file in sorted(folder.glob("runs/*.json"))]
    known = [result for result in results if result.method in order]

    def place(result: RunResult) -> tuple[str, int, int, int]:
        fold = -1 if result.fold is None else result.fold
        return result.environment, order.index(result.method), fold, result.seed

    return sorted(known, key=place)


def read_table(kind: type[Row], file: Path) -> list[Row]:
    """The rows of a CSV file as dataclasses; an empty cell is None, or False.

    Raises:
        CheckpointError: no such file, other columns than the fields of `kind`, or a cell of another type.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise CheckpointError(f"{file}: {error.strerror}") from None
    reader, fields = csv.DictReader(io.StringIO(text)), _fields(kind)
    columns: list[str] = [field.name for field in fields]
    if reader.fieldnames != columns:
        raise CheckpointError(f"{file} has columns {reader.fieldnames}; they must be {columns}")
    rows, adapter, empty = [], TypeAdapter(kind), dict[Any, Any]({bool: False})
    for values in reader:
        given = {field.name: values[field.name] or empty.get(field.type) for field in fields}
        try:
            rows.append(adapter.validate_python(given))
        except ValidationError as error:
            first = error.errors()[0]
            problem = f"{first['loc'][0]}: {first['msg']}, not {first['input']!r}"
            raise CheckpointError(f"{file}, line {reader.line_num}: {problem}") from None
    return rows


def write_table(kind: type[Row], file: Path, rows: Iterable[Row]) -> None:
    """Writes dataclasses as a CSV file, floats with six significant digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = [field.name for field in _fields(kind)]
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(getattr(row, column)) for column in columns])
    make_folders(file.parent)
    replace_file(file, stream.getvalue().encode())


def merged(old: Iterable[Row], new: Iterable[Row], key: Callable[[Row], Any]) -> list[Row]:
    """Rows of both, sorted by their keys; a new row takes the place of the old one of its key."""
    rows = {key(row): row for row in (*old, *new)}
    return [rows[place] for place in sorted(rows, key=str)]


def _fields(kind: type[Any]) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(kind)


def _cell(value: Any) -> str:
    if value is None or value is False:
        return ""
    if value is True:
        return YES
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)
