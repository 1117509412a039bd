"""The settings that tuning found, for the methods of an experiment."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from tcmrl_algo.algorithms.core.method import METHODS
from tcmrl_algo.experiment.config import Experiment
from tcmrl_algo.experiment.results import Tuned
from tcmrl_algo.tuning.space import searched
from tcmrl_algo.tuning.table import TrialRow, best_settings, read_trials
from tcmrl_data import TrainingError


def tuned_settings(
    experiment: Experiment, place: str | Path, *, environments: Sequence[str] = (), only: Sequence[str] = ()
) -> dict[str, dict[str, Tuned]]:
    """The best settings of every environment and algorithm of an experiment.

    Args:
        experiment: whose environments may name the environment of which the settings are.
        place: folder of tunings, each in `ENV-ALGO`, where `tcmrl tune` puts it; or a table of them.
        environments: those that are wanted; all where empty.
        only: labels of the methods that must be tuned; all where empty. Of others, those that exist are read.
            A method of which the experiment itself sets all that is searched need not be tuned.

    Raises:
        CheckpointError: a record or the table is damaged.
        TrainingError: a method was not tuned, no trial of it ended well, or methods of an environment were
            tuned with unequal effort.
    """
    trials = read_trials(Path(place))
    found = {
        environment: {
            algorithm: _tuned(trials, name, place, algorithm)
            for algorithm in sorted({method.algorithm for method in experiment.methods.values()})
            for name in [f"{choice.tuning or environment}-{algorithm}"]
            if algorithm in wanted or name in trials
        }
        for environment, choice in experiment.environments.items()
        if not environments or environment in environments
        for wanted in [_open_to_search(experiment, environment, only)]
    }
    for environment, settings in found.items():
        efforts = [(name, (one.trials, one.steps, one.seeds, one.root)) for name, one in settings.items()]
        for name, effort in efforts[1:]:
            first, expected = efforts[0]
            if effort != expected:
                raise TrainingError(
                    f"{place}: {first} was tuned for {environment} by {_effort(settings[first])}, {name} by "
                    f"{_effort(settings[name])}; tune methods with equal effort to compare them"
                )
    return found


def _open_to_search(experiment: Experiment, environment: str, only: Sequence[str]) -> set[str]:
    """The algorithms of methods of whose search the experiment leaves something open."""
    return {
        method.algorithm
        for label, method in experiment.methods.items()
        if not only or label in only
        if searched(METHODS.get(method.algorithm).search, experiment.overrides(environment, label))
    }


def _tuned(trials: Mapping[str, Sequence[TrialRow]], name: str, place: str | Path, algorithm: str) -> Tuned:
    if name not in trials:
        folder = "tuning" if Path(place).is_file() else place
        raise TrainingError(
            f"{place}: {name} holds no tuning; `tcmrl tune --algo {algorithm} --out {folder}/{name}` "
            "makes one"
        )
    found = best_settings(trials[name])
    if found is None:
        raise TrainingError(f"{place}, {name}: no trial ended well")
    return found


def _effort(tuned: Tuned) -> str:
    seeds = f"{len(tuned.seeds)} seed{'s' * (len(tuned.seeds) != 1)}"
    return f"{tuned.trials} trials of {tuned.steps} steps with {seeds} on {tuned.root[:12]}"
