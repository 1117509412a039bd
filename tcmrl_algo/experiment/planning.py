"""All runs of an experiment, resolved and checked before the first one starts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_algo.adaptation.protocols.base import PROTOCOLS
from tcmrl_algo.experiment.config import Experiment, run_id
from tcmrl_algo.experiment.datasets import fold_datasets, open_datasets
from tcmrl_algo.experiment.results import Tuned
from tcmrl_algo.training.config import TrainingConfig, installed_table, resolve
from tcmrl_data import CheckpointError, Dataset, TcmrlError, TrainingError
from tcmrl_data.foundation.canonical import leaves

TunedSettings = Mapping[str, Mapping[str, Tuned]]
"""Tuned settings by environment and algorithm."""


@dataclass(frozen=True)
class PlannedRun:
    """One run to do.

    Attributes:
        id: names its files.
        environment, method, seed, fold: which run it is.
        dataset, root: what it learns from.
        test_tasks: indices of the tasks that it does not see; folds of a dataset share a root.
        profile: whose training table it starts from.
        config: the resolved configuration; its `run.threads` is the driver's to set.
        protocols, curve_points: how it is evaluated.
        tuned: where its settings come from, if they were tuned.
    """

    id: str
    environment: str
    method: str
    seed: int
    fold: int | None
    dataset: Path
    root: str
    test_tasks: tuple[int, ...]
    profile: str
    config: TrainingConfig
    protocols: tuple[str, ...]
    curve_points: int
    tuned: Tuned | None = None

    def identity(self) -> dict[str, Any]:
        """Everything that the run's result is a function of, beside code, device and threads."""
        return {
            "root": self.root,
            "test_tasks": list(self.test_tasks),
            "seed": self.seed,
            "training": training_tables(self.config),
            "protocols": list(self.protocols),
            "curve_points": self.curve_points,
        }


def plan_runs(
    experiment: Experiment,
    *,
    data: Path,
    views: Path | None = None,
    environments: Sequence[str] = (),
    seeds: Sequence[int] | None = None,
    steps: int | None = None,
    tuned: TunedSettings | None = None,
) -> list[PlannedRun]:
    """Every run, all methods under one seed before the next seed.

    Args:
        experiment: the file.
        data: folder of datasets, one per environment; or one dataset, whatever the file says of its place.
        views: folder for the view files of folds, needed if the experiment has folds. They are written after
            all else was checked.
        environments: instead of all of the experiment's.
        seeds: instead of the experiment's.
        steps: training steps instead of `run.steps`, of runs and schedules.
        tuned: settings of environments and algorithms, which methods' own changes go over; the training
            table's for what it does not have, or where None.

    Raises:
        SelectionError: a dataset is missing, of another environment or profile, without test tasks, or
            without the snapshots that a method needs.
        TrainingError: an unknown method, algorithm, profile or protocol, or changes that do not validate.
    """
    _check_protocols(experiment)
    experiment = _on(experiment, environments)
    datasets = open_datasets(experiment, data)
    profiles = {
        environment: choice.profile or datasets[environment].manifest.profile
        for environment, choice in experiment.environments.items()
    }

    def found(environment: str, label: str) -> Tuned | None:
        return None if tuned is None else tuned[environment].get(experiment.methods[label].algorithm)

    configs = {
        environment: {
            label: _config(
                experiment, dataset, profiles[environment], label, steps, found(environment, label)
            )
            for label in experiment.methods
        }
        for environment, dataset in datasets.items()
    }
    splits = {environment: _splits(experiment, dataset, views) for environment, dataset in datasets.items()}
    return [
        PlannedRun(
            id=run_id(environment, label, seed, fold),
            environment=environment,
            method=label,
            seed=seed,
            fold=fold,
            dataset=dataset.path.resolve(),
            root=dataset.manifest.root,
            test_tasks=tuple(task.index for task in dataset.test_tasks),
            profile=profiles[environment],
            config=config,
            protocols=experiment.protocols,
            curve_points=experiment.curve_points,
            tuned=found(environment, label),
        )
        for environment in datasets
        for seed in (experiment.seeds if seeds is None else seeds)
        for fold, dataset in splits[environment].items()
        for label, config in configs[environment].items()
    ]


def _on(experiment: Experiment, environments: Sequence[str]) -> Experiment:
    """The experiment in these environments; in all of its own where none is named.

    Raises:
        TrainingError: it has no such environment.
    """
    unknown = [name for name in environments if name not in experiment.environments]
    if unknown:
        known = ", ".join(map(repr, experiment.environments))
        raise TrainingError(
            f"--environment {unknown[0]!r}: {experiment.name} has no such environment; they are {known}"
        )
    chosen = {name: choice for name, choice in experiment.environments.items() if name in environments}
    return experiment.model_copy(update={"environments": chosen}) if environments else experiment


def _splits(experiment: Experiment, dataset: Dataset, views: Path | None) -> dict[int | None, Dataset]:
    """The dataset itself under None, or its folds by number."""
    if experiment.folds is None:
        return {None: dataset}
    if views is None:
        raise TrainingError(f"experiment {experiment.name!r} has folds; say where their view files are made")
    return dict(enumerate(fold_datasets(dataset, views, experiment.folds)))


def training_tables(config: TrainingConfig) -> dict[str, Any]:
    """The training part of an identity: all settings but for the number of threads."""
    tables = config.settings.model_dump(mode="json")
    del tables["run"]["threads"]
    return tables | {config.settings.run.algorithm: config.method}


def completed(identity: Mapping[str, Any]) -> Mapping[str, Any]:
    """The identity of an earlier run; settings that are newer than the run have their defaults."""
    if not identity:  # of a result that a report keeps
        return identity
    try:
        return {**identity, "training": training_tables(resolve(identity["training"], place="identity"))}
    except TcmrlError:  # it has settings that are gone
        return identity


def check_same(done: Mapping[str, Any], planned: Mapping[str, Any], *, place: Path) -> None:
    """Refuses to go on with a run that was begun with other settings or data.

    Raises:
        CheckpointError: names the first value that differs.
    """
    before, now = _values(completed(done)), _values(planned)
    for key in sorted(before.keys() | now.keys()):
        if before.get(key) != now.get(key):
            raise CheckpointError(
                f"{place} was made with {key} {before.get(key)!r}, this experiment has "
                f"{now.get(key)!r}; choose another --out, or delete that run"
            )


def _check_protocols(experiment: Experiment) -> None:
    for protocol in experiment.protocols:
        try:
            PROTOCOLS.get(protocol)
        except TcmrlError as error:
            raise TrainingError(f"experiment {experiment.name!r}, protocols: {error}") from None


def resolve_method(
    experiment: Experiment,
    table: Mapping[str, Any],
    *,
    environment: str,
    label: str,
    place: str,
    steps: int | None = None,
    fallback: Mapping[str, Any] | None = None,
    tuned: Tuned | None = None,
) -> TrainingConfig:
    """A method's configuration: the table, then changes of tuning, experiment, environment and method.

    Raises:
        TrainingError: what results does not validate, or is shorter than the learning curve.
    """
    method = experiment.methods[label]
    texts = [*(tuned.overrides if tuned else ()), *experiment.overrides(environment, label)]
    if steps is not None:
        texts.append(f"run.steps={steps}")
    config = resolve(table, place=place, algorithm=method.algorithm, overrides=texts, fallback=fallback)
    if config.settings.run.steps < experiment.curve_points:
        raise TrainingError(
            f"{place}: {experiment.curve_points} curve_points need as many steps, not "
            f"{config.settings.run.steps}"
        )
    return config


def _config(
    experiment: Experiment,
    dataset: Dataset,
    profile: str,
    label: str,
    steps: int | None,
    tuned: Tuned | None,
) -> TrainingConfig:
    place = f"experiment {experiment.name!r}, method {label!r} on {dataset.name!r}, profile {profile!r}"
    table = {str(name): values for name, values in dataset.manifest.training.items()}.get(profile)
    if table is None:
        known = ", ".join(dataset.manifest.training)
        raise TrainingError(f"{place}: the dataset has no such training table; it has {known}")
    config = resolve_method(
        experiment,
        table,
        environment=dataset.name,
        label=label,
        place=place,
        steps=steps,
        fallback=installed_table(dataset.name, profile),
        tuned=tuned,
    )
    for rule in (config.settings.run.snapshots, config.settings.run.context_snapshots):
        if rule is not None:
            dataset.select(split="train", snapshots=rule)
    return config


def _values(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings by dotted names, those of training without its name."""
    named = {".".join(path): value for path, value in leaves(settings) if value != {}}
    return {name.removeprefix("training."): value for name, value in named.items()}
