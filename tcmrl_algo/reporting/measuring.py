"""What a report takes from checkpoints and datasets, kept in the compact results from then on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.reporting.contexts import FloatArray, IntArray, Trained, TransitionWeights
from tcmrl_algo.reporting.returns import DatasetReturns, dataset_returns
from tcmrl_algo.reporting.sources import Source
from tcmrl_data import TcmrlError


@dataclass(frozen=True)
class Contexts:
    """Contexts and attention of the first run of every method in one environment, for figures.

    Attributes:
        points: contexts by method, (trajectories, latent); methods without contexts are left out.
        labels: task of every context, by method.
        is_test: whether a task is a test task.
        weights: attention, by method; methods without attention are left out.
    """

    points: Mapping[str, FloatArray]
    labels: Mapping[str, IntArray]
    is_test: Sequence[bool]
    weights: Mapping[str, TransitionWeights]


@dataclass(frozen=True)
class Measured:
    """A source whose results are compact and hold everything that a report prints.

    Attributes:
        source: the experiment with compact results.
        contexts: by environment, as far as checkpoints and datasets are there.
        unmeasured: why an environment has no measured contexts, by environment.
    """

    source: Source
    contexts: Mapping[str, Contexts]
    unmeasured: Mapping[str, str]


def measure_source(source: Source) -> Measured:
    """Measures what checkpoints and datasets tell, and keeps what an earlier report measured."""
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
    return Measured(replace(source, runs=kept, datasets=datasets), contexts, unmeasured)


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
