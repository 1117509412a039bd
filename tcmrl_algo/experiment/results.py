"""What a run of an experiment leaves: one JSON document, one row of the table per protocol."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from tcmrl_algo.experiment.config import Experiment
from tcmrl_algo.training.config import TrainingConfig
from tcmrl_data.foundation.records import read_record

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


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CurvePoint(_Record):
    """One point of a learning curve, and what it took to get there.

    Attributes:
        step: training steps done.
        stage: of training, at that step.
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


class Tuned(_Record):
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


class ContextMeasures(_Record):
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


class RunResult(_Record):
    """A finished run: where it came from, what it learned, what it took.

    Attributes:
        experiment, method, algorithm, environment, seed, profile: which run this is.
        privileged: whether the method is a control that sees task parameters.
        fold: which fold of the tasks is its test split, in an experiment with folds.
        dataset, root: the dataset and its Merkle root.
        steps, device, threads: of training; results depend on device and threads in their last bits.
        identity: everything that the result is a function of, beside the code.
        config: the resolved training configuration.
        versions: of the packages that results depend on.
        digest: sha256 over all tensors, by which two runs compare.
        curve: the learning curve.
        evaluations: by protocol, the documents of `tcmrl evaluate --json`.
        training_seconds: of training alone, scaled up to all steps where a killed process did some of
            them; None where none was timed.
        evaluation_seconds: of all evaluations.
        peak_memory: bytes, of the process, or of the CUDA device where there is one.
        tuned: where its settings come from, if they were tuned.
        training_of: `experiment, method` whose training it shares, if it was not trained for this one.
        contexts: what a report measured of its contexts; None before, and without a checkpoint.
        behavior_seed: root seed of the dataset; None where none is known.
        commit: of this package's code, with `-dirty` where files were changed since; None where the code was
            no git checkout.
        processor: model name of what trained, a processor or a graphics card.
    """

    schema_version: Literal[1] = 1
    experiment: str
    method: str
    algorithm: str
    privileged: bool
    environment: str
    seed: int
    fold: int | None = None
    profile: str
    dataset: str
    root: str
    steps: int
    device: str
    threads: int
    identity: dict[str, Any]
    config: TrainingConfig
    versions: dict[str, str]
    digest: str
    curve: tuple[CurvePoint, ...]
    evaluations: dict[str, dict[str, Any]]
    training_seconds: float | None
    evaluation_seconds: float | None
    peak_memory: int | None
    tuned: Tuned | None = None
    training_of: str | None = None
    contexts: ContextMeasures | None = None
    behavior_seed: int | None = None
    commit: str | None = None
    processor: str | None = None

    @property
    def pair(self) -> tuple[int, int | None]:
        """Seed and fold, by which runs of two methods are compared."""
        return self.seed, self.fold

    @property
    def label(self) -> str:
        """Name of the method in tables and figures, which marks a control that observes task parameters."""
        return f"{self.method} (privileged)" if self.privileged else self.method

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table, one per protocol."""
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


def coverage(results: Sequence[RunResult]) -> str:
    """What an interval over these runs covers, such as `5 seeds, 1 split, 4 test tasks`.

    Runs without folds share one split of one dataset, so that an interval over them covers the training
    alone. With folds every task is a test task in one of them: it covers training on these splits.
    """
    seeds, folds = {result.seed for result in results}, {result.fold for result in results}
    tasks = {
        (task["task"], result.environment)
        for result in results
        for evaluation in result.evaluations.values()
        for task in evaluation["tasks"]
    }
    runs = _count(len(seeds), "seed")
    if folds - {None}:
        whole = len(results) % (len(seeds) * len(folds)) == 0
        runs = f"{'' if whole else f'{len(results)} of '}{runs} × {_count(len(folds), 'fold')}"
    else:
        runs += ", 1 split"
    return f"{runs}, {_count(len(tasks), 'test task')}" if results else "no run"


def by_method(results: Iterable[RunResult]) -> dict[str, list[RunResult]]:
    """Results of every method, in the order given, by its `label`."""
    found: dict[str, list[RunResult]] = {}
    for result in results:
        found.setdefault(result.label, []).append(result)
    return found


def result_file(folder: Path) -> Path:
    """Where the result of the run in a folder is written, as its last deed."""
    return folder.with_name(f"{folder.name}.json")


def error_file(folder: Path) -> Path:
    """Where it is said why the run in a folder failed, until it is tried again."""
    return folder / "error.txt"


def read_results(folder: Path, experiment: Experiment) -> list[RunResult]:
    """Every finished run in a results folder, by environment, method (in the file's order), fold and seed.

    Raises:
        CheckpointError: a result is not what a run writes.
    """
    results = [read_record(RunResult, file, remedy=AGAIN) for file in sorted(folder.glob("runs/*.json"))]
    order = list(experiment.methods)
    known = [result for result in results if result.method in order]

    def place(result: RunResult) -> tuple[str, int, int, int]:
        fold = -1 if result.fold is None else result.fold
        return result.environment, order.index(result.method), fold, result.seed

    return sorted(known, key=place)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
