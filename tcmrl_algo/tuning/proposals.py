"""What a trial draws: a function of the seed, the trial's number and the trials of earlier generations."""

from collections.abc import Sequence
from typing import Any

from tcmrl_algo.algorithms.core.method import SettingValue
from tcmrl_algo.tuning.record import Trial
from tcmrl_algo.tuning.space import Dimension, Space
from tcmrl_data import NO_TASK, Purpose, keyed_seed
from tcmrl_data.foundation.errors import MissingPackageError

GENERATION = 4
"""Trials that are proposed together, from the results of all earlier generations.

So what is proposed depends neither on how many trials run at a time nor on which of them ends first.
"""

RANDOM_TRIALS = 8
"""Ended trials before which proposals are drawn at random (Optuna's default: 10)."""


def known_to(number: int, trials: Sequence[Trial]) -> list[Trial]:
    """The ended trials of earlier generations than that of a trial."""
    first = number // GENERATION * GENERATION
    return [trial for trial in trials if trial.number < first and trial.is_done]


def propose(
    space: Space, known: Sequence[Trial], *, number: int, seed: int, environment: str
) -> dict[str, SettingValue]:
    """What a trial draws; trial 0 draws what gives the training table's own values.

    Proposals are those of the tree-structured Parzen estimator (Bergstra et al., 2011) of Optuna. It gets the
    known trials anew every time, so that nothing but their records need be kept.

    Args:
        space: what is searched.
        known: ended trials; one that diverged counts as worse than all others.
        number: of the trial.
        seed: of all proposals.
        environment: its name; part of every seed's key.

    Raises:
        MissingPackageError: Optuna is not installed.
    """
    if number == 0:
        return {key: dimension.first for key, dimension in space.items()}
    try:
        import optuna
    except ImportError as error:
        raise MissingPackageError(
            f"tuning needs a package that is missing ({error}); pip install 'tcmrl[tune]'"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    distributions = {key: _distribution(dimension) for key, dimension in space.items()}
    sampler = optuna.samplers.TPESampler(
        n_startup_trials=RANDOM_TRIALS,
        seed=keyed_seed(seed, environment, NO_TASK, Purpose.TUNING, number),
    )
    study = optuna.create_study(direction="maximize", sampler=sampler)
    for trial in known:
        ended = optuna.trial.TrialState.PRUNED if trial.score is None else optuna.trial.TrialState.COMPLETE
        study.add_trial(
            optuna.trial.create_trial(
                state=ended, params=trial.drawn, distributions=distributions, value=trial.score
            )
        )
    drawn = study.ask(distributions).params
    return {key: drawn[key] for key in space}


def _distribution(dimension: Dimension) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    if dimension.kind == "options":
        return CategoricalDistribution(dimension.options)
    assert dimension.low is not None and dimension.high is not None
    return FloatDistribution(dimension.low, dimension.high, log=True)
