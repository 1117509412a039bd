"""What tuning does, resolved and checked before the first trial starts."""

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

from tcmrl_algo.algorithms.core.method import METHODS, SettingValue
from tcmrl_algo.algorithms.core.settings import PROTOCOL_GROUP
from tcmrl_algo.experiment.config import override_texts
from tcmrl_algo.experiment.planning import training_tables
from tcmrl_algo.training.config import TrainingConfig, resolve_for
from tcmrl_algo.training.train import PACKAGES
from tcmrl_algo.tuning.holding_out import checked_tasks, held_out_tasks
from tcmrl_algo.tuning.record import Tuning
from tcmrl_algo.tuning.space import searched, space_on
from tcmrl_data import Dataset, Profile, TrainingError
from tcmrl_data.foundation.errors import MissingPackageError
from tcmrl_data.foundation.plugins import check_declared


@final
@dataclass(frozen=True)
class TuningPlan:
    """A tuning without its trials.

    Attributes:
        dataset: what to learn from.
        overrides: `section.key=value` texts that all trials share, the number of steps among them.
        tuning: the record, to which trials are added.
    """

    dataset: Dataset
    overrides: tuple[str, ...]
    tuning: Tuning

    def config(self, values: Mapping[str, SettingValue], *, threads: int) -> TrainingConfig:
        """The configuration of a trial's runs.

        Raises:
            TrainingError: the values do not validate.
        """
        return resolve_for(
            self.dataset,
            profile=self.tuning.profile,
            algorithm=self.tuning.algorithm,
            overrides=(*self.overrides, *override_texts(values), f"run.threads={threads}"),
        )


def plan_tuning(
    dataset: Dataset,
    *,
    algorithm: str,
    profile: Profile,
    steps: int | None,
    seeds: Sequence[int],
    seed: int,
    held_out: Sequence[int] | None,
    protocols: Sequence[str],
    overrides: Sequence[str],
) -> TuningPlan:
    """The plan of `tune_method`, whose arguments these are.

    Raises:
        TcmrlError: as of `tune_method`.
    """
    texts = (*overrides, *([] if steps is None else [f"run.steps={steps}"]))
    config = resolve_for(dataset, profile=profile, algorithm=algorithm, overrides=texts)
    for what, given in (("seeds", seeds), ("protocols", protocols)):
        if not given or len(set(given)) < len(given):
            raise TrainingError(f"{what} {list(given)}: name one or more, each once")
    for protocol in protocols:
        check_declared(PROTOCOL_GROUP, "protocol", protocol)
    tasks = held_out_tasks(dataset) if held_out is None else checked_tasks(dataset, held_out)
    _check_references(dataset, tasks)
    space = space_on(config, searched(METHODS.get(algorithm).search, overrides))
    if not space:
        raise TrainingError(f"nothing is left to search of {algorithm}; set fewer of its settings")
    tuning = Tuning(
        algorithm=algorithm,
        environment=dataset.name,
        profile=profile,
        root=dataset.manifest.root,
        seed=seed,
        seeds=tuple(seeds),
        steps=config.settings.run.steps,
        protocols=tuple(protocols),
        training_tasks=tuple(task.index for task in dataset.train_tasks if task.index not in tasks),
        held_out=tasks,
        space=space,
        identity={
            "root": dataset.manifest.root,
            "profile": profile,
            "seed": seed,
            "seeds": list(seeds),
            "protocols": list(protocols),
            "held_out": list(tasks),
            "training": training_tables(config),
            "space": {key: dimension.model_dump(mode="json") for key, dimension in space.items()},
        },
        versions=_versions(),
    )
    return TuningPlan(dataset, texts, tuning)


def _versions() -> dict[str, str]:
    try:
        return {name: importlib.metadata.version(name) for name in (*PACKAGES, "optuna", "tcmrl")}
    except importlib.metadata.PackageNotFoundError as error:
        raise MissingPackageError(
            f"tuning needs a package that is missing ({error.name}); pip install 'tcmrl[tune]'"
        ) from None


def _check_references(dataset: Dataset, tasks: Sequence[int]) -> None:
    """Scores are normalised returns, which a task without a return of uniform actions does not have."""
    for task in tasks:
        if dataset.references(task).uniform is None:
            raise TrainingError(
                f"{dataset.path}: no return of uniform actions is known of task {task}, so that its returns "
                "cannot be normalised; hold out other tasks"
            )
