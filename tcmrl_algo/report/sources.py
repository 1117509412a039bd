"""Inputs of a report: results folders and single runs, and what checkpoints and datasets tell of them."""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_algo.evaluation.evaluate import evaluate_run
from tcmrl_algo.evaluation.protocols.base import PROTOCOLS
from tcmrl_algo.experiment.results import (
    AGAIN,
    RunResult,
    error_file,
    read_results,
    result_file,
    rounded,
)
from tcmrl_algo.experiment.spec import Experiment, experiment_of, folder_name, read_experiment, run_id
from tcmrl_algo.report.contexts import FloatArray, IntArray, Trained, TransitionWeights
from tcmrl_algo.training.checkpoint import Run, open_run, tensors_digest
from tcmrl_data import CheckpointError, Dataset, TcmrlError, canonical_json, list_returns, open_dataset
from tcmrl_data.foundation.records import Frozen, read_record


class SnapshotReturns(Frozen):
    """Mean returns of the stored episodes of one snapshot, over tasks.

    Attributes:
        step: of the snapshot; None for all snapshots together.
        train, test: mean over training and over test tasks; None where there is no such snapshot.
    """

    step: int | None
    train: float | None
    test: float | None


class DatasetReturns(Frozen):
    """`datasets/ENVIRONMENT.json` of a report: what was stored in the dataset of an environment.

    Attributes:
        snapshots: by ascending step, and last all together.
    """

    environment: str
    root: str
    profile: str
    train_tasks: int
    test_tasks: int
    snapshots: tuple[SnapshotReturns, ...]

    @property
    def test_return(self) -> float | None:
        """Mean return of all stored episodes of the test tasks."""
        return self.snapshots[-1].test if self.snapshots else None


def dataset_returns(dataset: Dataset) -> DatasetReturns:
    """Mean returns of the stored episodes of a dataset, over tasks, by snapshot."""
    tasks = list_returns(dataset)["tasks"]
    steps: list[int | None] = sorted({found["step"] for task in tasks for found in task["snapshots"]})
    return DatasetReturns(
        environment=dataset.name,
        root=dataset.manifest.root,
        profile=dataset.manifest.profile,
        train_tasks=len(dataset.train_tasks),
        test_tasks=len(dataset.test_tasks),
        snapshots=tuple(
            SnapshotReturns(step=step, train=_mean(tasks, "train", step), test=_mean(tasks, "test", step))
            for step in (*steps, None)
        ),
    )


def _mean(tasks: Sequence[dict[str, Any]], split: str, step: int | None) -> float | None:
    means = [
        found["mean"]
        for task in tasks
        if task["split"] == split
        for found in task["snapshots"]
        if step in (None, found["step"])
    ]
    mean: float | None = rounded(float(np.mean(means))) if means else None
    return mean


@dataclass(frozen=True)
class Contexts:
    """Contexts and attention of the first run of every method in one environment, for figures.

    Attributes:
        points: contexts by method, (trajectories, latent); methods without contexts are left out.
        labels: task of every context, by method.
        weights: attention, by method; methods without attention are left out.
    """

    points: Mapping[str, FloatArray]
    labels: Mapping[str, IntArray]
    is_test: Sequence[bool]
    weights: Mapping[str, TransitionWeights]


@dataclass(frozen=True)
class Source:
    """An experiment and its finished runs, ordered by environment, method, fold and seed.

    Attributes:
        unfinished: ids of its other runs, with the error of those that failed.
        datasets: returns of the datasets, by environment, as far as they are known.
        contexts: for figures, by environment, as far as checkpoints and datasets are there.
        unmeasured: why an environment has no measured contexts, by environment.
    """

    experiment: Experiment
    runs: tuple[RunResult, ...]
    unfinished: Mapping[str, str | None] = field(default_factory=dict)
    datasets: Mapping[str, DatasetReturns] = field(default_factory=dict)
    contexts: Mapping[str, Contexts] = field(default_factory=dict)
    unmeasured: Mapping[str, str] = field(default_factory=dict)

    @property
    def failed(self) -> dict[str, str]:
        """Errors of the runs that failed, by id."""
        return {name: error for name, error in self.unfinished.items() if error is not None}

    @property
    def missing(self) -> list[str]:
        """The unfinished runs as text: those that failed with their errors, the others counted.

        Others are counted by method, and by environment where no run in it is finished.
        """
        reached = {folder_name(environment) for environment in self.environments()}
        silent = [name.split("--") for name, error in self.unfinished.items() if error is None]
        numbers = Counter("--".join(parts[: 2 if parts[0] in reached else 1]) for parts in silent)
        failed = [f"`{name}` ({error})" for name, error in self.failed.items()]
        return [*failed, *(f"{number} of `{place}`" for place, number in numbers.items())]

    def environments(self) -> list[str]:
        """Environments with finished runs."""
        return list(dict.fromkeys(run.environment for run in self.runs))

    def results(self, environment: str) -> list[RunResult]:
        """Finished runs in an environment."""
        return [run for run in self.runs if run.environment == environment]

    def stored_return(self, environment: str) -> float | None:
        """Mean return of the stored episodes of the test tasks; None where no report measured it."""
        kept = self.datasets.get(environment)
        return None if kept is None else kept.test_return


def read_sources(
    paths: Sequence[Path],
    report: Callable[[str, int, int], None] | None = None,
    *,
    datasets: Sequence[Path] = (),
) -> list[Source]:
    """Reads results folders in the given order; then all run folders as one source, evaluating the runs.

    Args:
        paths: the folders; of a folder of results folders, all in it by name.
        report: called when run folders are evaluated.
        datasets: folders of datasets that were moved after the training of the runs.

    Raises:
        CheckpointError: not a results or run folder, no finished run in it, or a dataset of no run.
    """
    places = {open_dataset(folder).manifest.root: str(folder.resolve()) for folder in datasets}
    sources, runs = [], []
    for path in paths:
        inner = sorted(path.glob("*/experiment.json"), key=lambda file: natural_order(file.parent.name))
        if (path / "experiment.json").is_file():
            sources.append(_results_folder(path, places))
        elif (path / "run.json").is_file():
            runs.append(open_run(path))
        elif inner:
            sources += [_results_folder(file.parent, places) for file in inner]
        else:
            raise CheckpointError(
                f"{path} contains neither experiment.json nor run.json; name a folder of "
                "`tcmrl experiment` or `tcmrl train`"
            )
    if runs:
        sources.append(_single_runs(runs, report, places))
    used = {run.root for source in sources for run in source.runs}
    for root, place in places.items():
        if root not in used:
            raise CheckpointError(
                f"--dataset {place} has root {root[:12]}, on which no run was trained; omit it"
            )
    return sources


def natural_order(name: str) -> list[tuple[str, int]]:
    """Sorts `figure13` after `figure4`."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name)]


def _relocated(result: RunResult, places: Mapping[str, str]) -> RunResult:
    """A result with the present folder of its dataset; views of folds have the root of their source."""
    if result.fold is not None:
        return result
    return result.model_copy(update={"dataset": places.get(result.root, result.dataset)})


def _results_folder(path: Path, places: Mapping[str, str]) -> Source:
    experiment = experiment_of(path)
    found = [_relocated(result, places) for result in read_results(path, experiment)]
    if not found:
        raise CheckpointError(f"{path} contains no finished run; continue with `tcmrl experiment`")
    records = [
        read_record(DatasetReturns, file, remedy=AGAIN) for file in sorted(path.glob("datasets/*.json"))
    ]
    datasets = {record.environment: record for record in records}
    return Source(experiment, tuple(found), _unfinished(path, experiment), datasets)


def _unfinished(path: Path, experiment: Experiment) -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for environment, (method, choice), seed, fold in itertools.product(
        experiment.environments, experiment.methods.items(), experiment.seeds, experiment.fold_numbers
    ):
        if not choice.runs_in(environment):
            continue
        name = run_id(environment, method, seed, fold)
        if not result_file(path / "runs" / name).is_file():
            error = error_file(path / "runs" / name)
            found[name] = error.read_text(encoding="utf-8").strip() if error.is_file() else None
    return found


def _single_runs(
    runs: Sequence[Run], report: Callable[[str, int, int], None] | None, places: Mapping[str, str]
) -> Source:
    """Single runs as an experiment; runs of one algorithm are the seeds of one method."""
    labels = labels_of(runs)
    experiment = read_experiment(
        {
            "schema": 1,
            "name": "runs",
            "title": "Single runs",
            "source": "none",
            "seeds": sorted({run.record.seed for run in runs}),
            "environments": {run.record.environment: {} for run in runs},
            "methods": {
                label: {"algorithm": run.record.config.settings.run.algorithm}
                for label, run in zip(labels, runs, strict=True)
            },
        },
        place="the run folders",
    )
    found = []
    for done, (label, run) in enumerate(zip(labels, runs, strict=True), start=1):
        found.append(_evaluated(label, run, places.get(run.record.root)))
        if report is not None:
            report("evaluating", done, len(runs))
    order = list(experiment.methods)

    def place_of(run: RunResult) -> tuple[str, int, int]:
        return run.environment, order.index(run.method), run.seed

    return Source(experiment, tuple(sorted(found, key=place_of)))


def labels_of(runs: Sequence[Run]) -> list[str]:
    """Labels of runs: the algorithm, and the folder's name if its runs differ by more than the seed."""
    groups: dict[tuple[str, str], list[Run]] = {}
    names = [run.record.config.settings.run.algorithm for run in runs]
    for name, run in zip(names, runs, strict=True):
        groups.setdefault((name, run.record.environment), []).append(run)
    mixed = {name for (name, _), group in groups.items() if not _are_seeds(group)}
    return [
        f"{name} {run.folder.name}" if name in mixed else name for name, run in zip(names, runs, strict=True)
    ]


def _are_seeds(runs: Sequence[Run]) -> bool:
    """Whether the runs differ only by their seeds."""
    kinds = {
        (canonical_json(run.record.config.model_dump(mode="json")), run.record.root, run.newest().step)
        for run in runs
    }
    return len(kinds) == 1 and len({run.record.seed for run in runs}) == len(runs)


def _evaluated(label: str, run: Run, place: str | None) -> RunResult:
    record = run.record
    documents = {
        name: evaluate_run(run.folder, protocol=name, dataset_path=place).to_json()
        for name in PROTOCOLS.working()
    }
    return RunResult(
        folder=run.folder,
        experiment="runs",
        method=label,
        algorithm=record.config.settings.run.algorithm,
        privileged=record.privileged,
        environment=record.environment,
        seed=record.seed,
        profile=record.profile,
        dataset=place or record.dataset,
        root=record.root,
        steps=run.newest().step,
        device=record.device,
        threads=record.config.settings.run.threads,
        identity={},
        config=record.config,
        versions=record.versions,
        digest=tensors_digest(run.newest().tensors()),
        curve=(),
        evaluations=documents,
        training_seconds=None,
        evaluation_seconds=None,
        peak_memory=None,
    )


def measured(source: Source) -> Source:
    """The source with compact results that hold what checkpoints and datasets tell, or an earlier report."""
    trained = Trained()
    results: dict[str, list[RunResult]] = {}
    datasets, contexts, unmeasured = dict(source.datasets), {}, {}
    for environment in source.environments():
        runs = source.results(environment)
        try:
            results[environment] = [_measured(run, trained) for run in runs]
            contexts[environment] = _contexts(runs, trained)
            datasets[environment] = dataset_returns(trained.stored(runs[0]).dataset)
        except TcmrlError as error:
            results[environment] = runs
            if not _has_measures(environment, runs, datasets):
                unmeasured[environment] = str(error)
    kept = tuple(result.compact() for found in results.values() for result in found)
    return replace(source, runs=kept, datasets=datasets, contexts=contexts, unmeasured=unmeasured)


def _measured(run: RunResult, trained: Trained) -> RunResult:
    return run.model_copy(update={"contexts": trained.contexts(run).measures()})


def _has_measures(
    environment: str, runs: Sequence[RunResult], datasets: Mapping[str, DatasetReturns]
) -> bool:
    return environment in datasets and all(run.contexts is not None for run in runs)


def _contexts(runs: Sequence[RunResult], trained: Trained) -> Contexts:
    first: dict[str, RunResult] = {}
    for run in runs:
        if run.fold == runs[0].fold:
            first.setdefault(run.label, run)
    found = {method: trained.contexts(run) for method, run in first.items()}
    points = {method: run.contexts for method, run in found.items() if run.contexts is not None}
    return Contexts(
        points=points,
        labels={method: found[method].labels for method in points},
        is_test=[task.split == "test" for task in trained.stored(runs[0]).tasks],
        weights={method: run.weights for method, run in found.items() if run.weights is not None},
    )
