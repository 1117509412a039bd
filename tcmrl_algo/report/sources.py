"""Inputs of a report: results folders, and what checkpoints and datasets tell of them."""

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_algo.experiment.results import RunResult, error_file, read_results, result_file
from tcmrl_algo.experiment.spec import Experiment, experiment_of, folder_name, run_id
from tcmrl_algo.report.contexts import FloatArray, IntArray, Trained, TransitionWeights
from tcmrl_data import CheckpointError, Dataset, TcmrlError, list_returns, open_dataset


@dataclass(frozen=True)
class SnapshotReturns:
    """Mean returns of the stored episodes of one snapshot, over tasks.

    Attributes:
        step: of the snapshot; None for all snapshots together.
        train, test: mean over training and over test tasks; None where there is no such snapshot.
    """

    step: int | None
    train: float | None
    test: float | None


@dataclass(frozen=True)
class DatasetReturns:
    """What is stored in the dataset of an environment.

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
    return float(np.mean(means)) if means else None


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
    def missing(self) -> list[str]:
        """The unfinished runs as text: those that failed with their errors, the others counted.

        Others are counted by method, and by environment where no run in it is finished.
        """
        reached = {folder_name(environment) for environment in self.environments()}
        silent = [name.split("--") for name, error in self.unfinished.items() if error is None]
        numbers = Counter("--".join(parts[: 2 if parts[0] in reached else 1]) for parts in silent)
        failed = [f"`{name}` ({error})" for name, error in self.unfinished.items() if error is not None]
        return [*failed, *(f"{number} of `{place}`" for place, number in numbers.items())]

    def environments(self) -> list[str]:
        """Environments with finished runs."""
        return list(dict.fromkeys(run.environment for run in self.runs))

    def results(self, environment: str) -> list[RunResult]:
        """Finished runs in an environment."""
        return [run for run in self.runs if run.environment == environment]

    def stored_return(self, environment: str) -> float | None:
        """Mean return of the stored episodes of the test tasks; None where the dataset is gone."""
        kept = self.datasets.get(environment)
        return None if kept is None else kept.test_return


def read_sources(paths: Sequence[Path], *, datasets: Sequence[Path] = ()) -> list[Source]:
    """Reads results folders in the given order.

    Args:
        paths: the folders; of a folder of results folders, all in it by name.
        datasets: folders of datasets that were moved after the training of the runs.

    Raises:
        CheckpointError: not a results folder, no finished run in it, or a dataset of no run.
    """
    places = {open_dataset(folder).manifest.root: str(folder.resolve()) for folder in datasets}
    sources = []
    for path in paths:
        inner = sorted(path.glob("*/experiment.json"), key=lambda file: natural_order(file.parent.name))
        if (path / "experiment.json").is_file():
            sources.append(_results_folder(path, places))
        elif inner:
            sources += [_results_folder(file.parent, places) for file in inner]
        else:
            raise CheckpointError(
                f"{path} contains no experiment.json; name a results folder of `tcmrl experiment`"
            )
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
    return Source(experiment, tuple(found), _unfinished(path, experiment))


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


def measured(source: Source) -> Source:
    """The source with what checkpoints and datasets tell of its runs, as far as they are there."""
    trained = Trained()
    results: list[RunResult] = []
    datasets: dict[str, DatasetReturns] = {}
    contexts: dict[str, Contexts] = {}
    unmeasured: dict[str, str] = {}
    for environment in source.environments():
        runs = source.results(environment)
        try:
            results += [_measured(run, trained) for run in runs]
            contexts[environment] = _contexts(runs, trained)
            datasets[environment] = dataset_returns(trained.stored(runs[0]).dataset)
        except TcmrlError as error:
            results += runs
            unmeasured[environment] = str(error)
    return replace(source, runs=tuple(results), datasets=datasets, contexts=contexts, unmeasured=unmeasured)


def _measured(run: RunResult, trained: Trained) -> RunResult:
    return run.model_copy(update={"contexts": trained.contexts(run).measures()})


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
