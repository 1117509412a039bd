"""All runs of an experiment, resolved and checked before the first one starts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tcmrl_algo.algorithms.core.settings import TrainingConfig
from tcmrl_algo.evaluation.protocols.base import PROTOCOLS
from tcmrl_algo.experiment.datasets import fold_datasets, open_datasets
from tcmrl_algo.experiment.results import Job, Tuned, TunedSettings
from tcmrl_algo.experiment.spec import Experiment, run_id
from tcmrl_algo.training.config import installed_table, resolve
from tcmrl_data import (
    CheckpointError,
    Dataset,
    TcmrlError,
    TrainingError,
)
from tcmrl_data.foundation.records import leaves


def plan_runs(
    experiment: Experiment,
    *,
    data: Path | None,
    out: Path,
    environments: Sequence[str] = (),
    seeds: Sequence[int] | None = None,
    steps: int | None = None,
    overrides: Sequence[str] = (),
    tuned: TunedSettings | None = None,
    threads: int = 1,
    device: str = "cpu",
) -> list[Job]:
    """Every run, all methods under one seed before the next seed.

    Args:
        data: as for `run_experiment`.
        out: the results folder. View files of folds are written there, after all else was checked.
        environments: instead of all of the experiment's.
        seeds: instead of the experiment's.
        steps: training steps instead of `run.steps`, of runs and schedules.
        overrides: `section.key=value` texts for all runs, which the experiment's own changes go over.
        tuned: settings of environments and algorithms, which methods' own changes go over; the training
            table's for what it does not have, or where None.

    Raises:
        SelectionError: a dataset is missing, of another environment or profile, without test tasks, or
            without the snapshots that a method needs.
        TrainingError: an unknown method, algorithm, profile or protocol, or changes that do not validate.
    """
    _check_protocols(experiment)
    experiment = experiment.on(environments)
    datasets = open_datasets(experiment, data)
    profiles = {
        environment: choice.profile or datasets[environment].manifest.profile
        for environment, choice in experiment.environments.items()
    }

    def found(environment: str, label: str) -> Tuned | None:
        return None if tuned is None else tuned[environment].get(experiment.methods[label].algorithm)

    configs = {
        (environment, label): _config(
            experiment,
            dataset,
            profiles[environment],
            label,
            steps=steps,
            overrides=overrides,
            threads=threads,
            tuned=found(environment, label),
        )
        for environment, dataset in datasets.items()
        for label, method in experiment.methods.items()
        if method.runs_in(environment)
    }
    splits = {
        environment: fold_datasets(dataset, out / "folds", experiment.folds)
        for environment, dataset in datasets.items()
    }
    return [
        Job(
            experiment=experiment.name,
            environment=environment,
            method=label,
            seed=seed,
            fold=fold,
            folder=str((out / "runs" / run_id(environment, label, seed, fold)).resolve()),
            dataset=str(dataset.path.resolve()),
            root=dataset.manifest.root,
            profile=profiles[environment],
            device=device,
            config=configs[environment, label],
            identity={
                "root": dataset.manifest.root,
                "test_tasks": [task.index for task in dataset.test_tasks],  # folds of a dataset share a root
                "seed": seed,
                "training": training_tables(configs[environment, label]),
                "protocols": list(experiment.protocols),
                "curve_points": experiment.curve_points,
            },
            protocols=experiment.protocols,
            curve_points=experiment.curve_points,
            tuned=found(environment, label),
        )
        for environment in datasets
        for seed in (experiment.seeds if seeds is None else seeds)
        for fold, dataset in splits[environment].items()
        for label in experiment.methods
        if (environment, label) in configs
    ]


def training_tables(config: TrainingConfig) -> dict[str, Any]:
    """The training part of an identity: all settings but for the number of threads."""
    tables = config.settings.model_dump(mode="json")
    del tables["run"]["threads"]
    return tables | {config.settings.run.algorithm: config.method}


def with_threads(config: TrainingConfig, threads: int) -> TrainingConfig:
    """The configuration with another number of CPU threads."""
    run = config.settings.run.model_copy(update={"threads": threads})
    return config.model_copy(update={"settings": config.settings.model_copy(update={"run": run})})


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
    shared: Sequence[str] = (),
    fallback: Mapping[str, Any] | None = None,
    tuned: Tuned | None = None,
) -> TrainingConfig:
    """A method's configuration: table, tuning, changes of all runs, experiment, environment, method.

    Raises:
        TrainingError: what results does not validate, or is shorter than the learning curve.
    """
    method = experiment.methods[label]
    texts = [*(tuned.overrides if tuned else ()), *shared, *experiment.overrides(environment, label)]
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
    *,
    steps: int | None,
    overrides: Sequence[str],
    threads: int,
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
        shared=overrides,
        fallback=installed_table(dataset.name, profile),
        tuned=tuned,
    )
    config = with_threads(config, threads)
    for rule in (config.settings.run.snapshots, config.settings.run.context_snapshots):
        if rule is not None:
            dataset.select(split="train", snapshots=rule)
    return config


def _values(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings by dotted names, those of training without its name."""
    named = {".".join(path): value for path, value in leaves(settings) if value != {}}
    return {name.removeprefix("training."): value for name, value in named.items()}
