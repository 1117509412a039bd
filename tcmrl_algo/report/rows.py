"""Results as rows of tables: `runs.csv`, and beside it `curves.csv`, `tuning.csv` and `worth.csv`.

The table outlives results folders: a row holds what comparisons need, and names data, settings and code.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_algo.algorithms.core.settings import LOGGING_KEYS, TrainingSettings
from tcmrl_algo.experiment.results import (
    ContextMeasures,
    Row,
    RunResult,
    merged,
    read_table,
    success_rate,
    write_table,
)
from tcmrl_algo.experiment.tunings import TrialRow, read_tuning, trial_rows
from tcmrl_algo.report.sources import DatasetReturns, Source
from tcmrl_algo.training.config import stage_plan
from tcmrl_data import Worth
from tcmrl_data.foundation.records import digest, read_record

Pair = tuple[str, int | None, int]
"""Root of the data, fold and seed, by which runs of two methods are compared."""
RUNS, CURVES, WORTH = "runs.csv", "curves.csv", "worth.csv"
HEX_DIGITS = 16
"""Of roots and digests."""
UNKNOWN = "unknown"
SHARED = (
    "environment",
    "behavior_seed",
    "profile",
    "method",
    "algorithm",
    "privileged",
    "seed",
    "fold",
    "steps",
)
MEASURED = ("context_ratio", "centroid_accuracy", "attention_zero", "attention_nonzero")
"""What a row has of `RunResult` and `ContextMeasures` as it is."""
SPLIT = ("tasks", "own", "single", "uniform", "best", "worth", "low", "high")
"""What a row has of a split of `Worth` as it is."""


@dataclass(frozen=True)
class RunRow:
    """A run under one protocol. Returns and scores are means over the test tasks.

    Attributes:
        experiment: name of its results folder.
        dataset_profile: the profile that the dataset was built with.
        behavior_seed: root seed of the dataset.
        root: of the dataset, the first 16 digits. Only rows of one root compare.
        profile: whose training table was the start.
        privileged: whether the method observes the task parameters.
        actor_critic: what trains the policy: `sac`, `sac+brac`, `sac+cloning`, `iql`, `bc`, or `own`.
        snapshots: which snapshots transitions come from: `all`, `last` or a condition.
        context_snapshots: the same of contexts, where it differs.
        tuned: trials and steps of the search for the settings, and where.
        seed, fold: of the run; no fold where the dataset's own split was used.
        final: return after adaptation.
        shuffled: return with the contexts of other tasks.
        regret: oracle minus final.
        normalized: 0 for uniform actions, 1 for the oracle or, without one, the best behavior policy.
        success: share of successful final episodes.
        random, oracle, behavior, fixed: returns of uniform actions, of a controller that knows the task, of
            the best behavior policy of each task, and of the best policy that acts the same in all tasks.
        stored: return of all stored episodes of the test tasks.
        context_ratio, centroid_accuracy, attention_zero, attention_nonzero: of `ContextMeasures`.
        steps, policy_steps: of training, and of those the ones that train the policy.
        ms_per_step: milliseconds of training a step.
        peak_mb: megabytes that the process held at most, or the tensors on a CUDA device.
        digest: of all tensors, 16 digits.
        settings: digest of everything that the method was told, 16 digits.
        commit, processor: of `RunResult`.
    """

    experiment: str
    environment: str
    dataset_profile: str | None
    behavior_seed: int | None
    root: str
    profile: str
    method: str
    algorithm: str
    privileged: bool
    actor_critic: str
    snapshots: str
    context_snapshots: str | None
    tuned: str | None
    seed: int
    fold: int | None
    protocol: str
    test_tasks: int
    final: float
    shuffled: float | None
    regret: float | None
    normalized: float | None
    success: float | None
    random: float | None
    oracle: float | None
    behavior: float | None
    fixed: float | None
    stored: float | None
    context_ratio: float | None
    centroid_accuracy: float | None
    attention_zero: float | None
    attention_nonzero: float | None
    steps: int
    policy_steps: int
    ms_per_step: float | None
    peak_mb: float | None
    digest: str
    settings: str
    commit: str
    processor: str

    @property
    def pair(self) -> Pair:
        """Data, fold and seed, by which runs of two methods are compared."""
        return self.root, self.fold, self.seed


@dataclass(frozen=True)
class CurveRow:
    """A point of a run's learning curve, under the experiment's first protocol."""

    experiment: str
    environment: str
    root: str
    method: str
    seed: int
    fold: int | None
    protocol: str
    step: int
    final: float
    shuffled: float

    @property
    def pair(self) -> Pair:
        """As `RunRow.pair`."""
        return self.root, self.fold, self.seed


@dataclass(frozen=True)
class WorthRow:
    """What `inspect worth` says of one split of a dataset.

    Attributes:
        dataset: name of the file that it came from.
        environment, root: which dataset.
        own, single, uniform, best: returns of the tasks' own last policies, of the best single policy, of
            uniform actions, and the best that is known.
        worth, low, high: what a context can gain, as a share, with its 95% bootstrap interval over tasks.
        rewarded_first, …: share of rewarded steps and visibility of the task, at the first and last stage.
    """

    dataset: str
    environment: str
    root: str
    split: str
    tasks: int
    own: float
    single: float
    uniform: float | None
    best: float
    worth: float | None
    low: float | None
    high: float | None
    rewarded_first: float | None
    rewarded_last: float | None
    reward_first: float | None
    reward_last: float | None
    dynamics_first: float | None
    dynamics_last: float | None


def add_rows(file: Path, sources: Iterable[Source]) -> list[RunRow]:
    """Puts the runs of results folders into a table, and their learning curves into `curves.csv` beside it.

    A row takes the place of an earlier one of the same experiment, data, method, seed, fold and protocol.

    Args:
        file: the table; it is made if there is none.
        sources: of results folders, whose names the experiments have in the table.

    Returns:
        The rows of these runs.

    Raises:
        CheckpointError: `file` is no such table.
    """
    rows: list[RunRow] = []
    curves: list[CurveRow] = []
    for source in sources:
        folder = (source.runs[0].folder or Path()).parents[1]
        for result in source.runs:
            rows += run_rows(folder.resolve().name, result, source.datasets.get(result.environment))
            curves += curve_rows(folder.resolve().name, result, source.experiment.protocols[0])
    _update(RunRow, file, rows, _run_key)
    if curves:
        _update(CurveRow, file.with_name(CURVES), curves, _run_key)
    return rows


def add_tunings(file: Path, folders: Sequence[Path]) -> list[TrialRow]:
    """Puts the trials of folders of `tcmrl tune` into a table, `tuning.csv`; the rows of these.

    Raises:
        CheckpointError: a folder holds no tuning, or `file` is no such table.
    """
    rows = [row for folder in folders for row in trial_rows(folder.resolve().name, read_tuning(folder))]
    _update(TrialRow, file, rows, lambda row: (row.tuning, f"{row.trial:06}"))
    return rows


def add_worth(file: Path, documents: Sequence[Path]) -> list[WorthRow]:
    """Puts documents of `inspect worth --json` into a table, `worth.csv`; the rows of these.

    Raises:
        CheckpointError: a document is none, or `file` is no such table.
    """
    rows = [row for document in documents for row in worth_rows(document.stem, read_record(Worth, document))]
    _update(WorthRow, file, rows, lambda row: (row.dataset, row.split))
    return rows


def run_rows(experiment: str, result: RunResult, stored: DatasetReturns | None) -> list[RunRow]:
    """Rows of a run, one per protocol."""
    known = stored if stored is not None and stored.root == result.root else None
    settings, tuned = result.config.settings, result.tuned
    contexts = result.contexts or ContextMeasures(tasks=0)
    other = settings.run.context_snapshots
    seconds, memory = result.training_seconds, result.peak_memory
    shared: dict[str, Any] = {name: getattr(result, name) for name in SHARED}
    shared |= {name: getattr(contexts, name) for name in MEASURED}
    return [
        RunRow(
            experiment=experiment,
            dataset_profile=None if known is None else known.profile,
            root=result.root[:HEX_DIGITS],
            actor_critic=actor_critic(settings, result.algorithm),
            snapshots=str(settings.run.snapshots),
            context_snapshots=None if other in (None, settings.run.snapshots) else str(other),
            tuned=None if tuned is None else f"{tuned.trials} x {tuned.steps} on {tuned.environment}",
            protocol=protocol,
            test_tasks=len(evaluation["tasks"]),
            success=success_rate(evaluation),
            stored=None if known is None or result.fold is not None else known.test_return,
            policy_steps=tuple(stage_plan(result.config))[-1].steps,
            ms_per_step=None if seconds is None else 1e3 * seconds / result.steps,
            peak_mb=None if memory is None else memory / 1e6,
            digest=result.digest[:HEX_DIGITS],
            settings=settings_digest(result),
            commit=result.commit or UNKNOWN,
            processor=result.processor or UNKNOWN,
            **shared,
            **_scores(evaluation),
        )
        for protocol, evaluation in result.evaluations.items()
    ]


def _scores(evaluation: dict[str, Any]) -> dict[str, Any]:
    scores = {name: evaluation[f"mean_{name}"] for name in ("final", "shuffled", "regret", "normalized")}
    others = ("random", "oracle", "behavior", "fixed")
    return scores | {name: _mean(evaluation["tasks"], name) for name in others}


def curve_rows(experiment: str, result: RunResult, protocol: str) -> list[CurveRow]:
    """The points of a learning curve; none of one that has its end alone."""
    run = (result.environment, result.root[:HEX_DIGITS], result.method, result.seed, result.fold)
    points = result.curve if len(result.curve) > 1 else ()
    return [CurveRow(experiment, *run, protocol, point.step, point.final, point.shuffled) for point in points]


def worth_rows(dataset: str, worth: Worth) -> list[WorthRow]:
    """Rows of a document of `inspect worth --json`, one per split."""
    rows = []
    for split in worth.splits:
        stages = [stage for stage in worth.stages if stage.split == split.split]
        first, last = (stages[0], stages[-1]) if stages else (None, None)
        values: dict[str, Any] = {name: getattr(split, name) for name in SPLIT}
        for when, stage in (("first", first), ("last", last)):
            for name in ("rewarded", "reward", "dynamics"):
                values[f"{name}_{when}"] = getattr(stage, name, None)
        where = (dataset, worth.environment, worth.root[:HEX_DIGITS], split.split)
        rows.append(WorthRow(*where, **values))
    return rows


def actor_critic(settings: TrainingSettings, algorithm: str) -> str:
    """What trains the policy of a run, as the table says it."""
    if algorithm == "macaw":
        return "own"
    if settings.actor_critic.kind != "sac":
        return settings.actor_critic.kind
    regularized = settings.actor_critic.brac.mode != "off"
    return f"sac{'+brac' * regularized}{'+cloning' * (settings.actor_critic.cloning > 0)}"


def settings_digest(result: RunResult) -> str:
    """Digest of all settings but seed, threads and those that change no result."""
    config = result.config.model_dump(mode="json")
    for key in (*LOGGING_KEYS, "threads", "protocol"):
        config["settings"]["run"].pop(key, None)
    return digest([config, result.steps])[:HEX_DIGITS]


def _mean(tasks: Sequence[dict[str, Any]], name: str) -> float | None:
    values = [task.get(name) for task in tasks]
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _update(kind: type[Row], file: Path, rows: Iterable[Row], key: Callable[[Row], Any]) -> None:
    write_table(kind, file, merged(read_table(kind, file) if file.exists() else [], rows, key))


def _run_key(row: RunRow | CurveRow) -> tuple[str, ...]:
    run = (row.experiment, row.environment, row.root, row.method, f"{row.seed:06}", str(row.fold))
    return *run, row.protocol if isinstance(row, RunRow) else f"{row.step:09}"
