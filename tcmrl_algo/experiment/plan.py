"""An experiment resolved: its datasets found, built or cut into folds, and all runs checked first."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_algo.adaptation.protocols.base import PROTOCOLS
from tcmrl_algo.experiment.results import Job, Tuned
from tcmrl_algo.experiment.spec import EnvironmentChoice, Experiment, folder_name, run_id
from tcmrl_algo.training.config import TrainingConfig, installed_table, resolve
from tcmrl_data import (
    BuildEvent,
    CheckpointError,
    Dataset,
    Profile,
    SelectionError,
    TcmrlError,
    TrainingError,
    build_dataset,
    is_view_file,
    load_recipe,
    open_dataset,
    split_dataset,
)
from tcmrl_data.foundation.canonical import leaves

TunedSettings = Mapping[str, Mapping[str, Tuned]]
"""Tuned settings by environment and algorithm."""


@dataclass(frozen=True)
class MissingDataset:
    """A dataset that an experiment needs and that does not exist.

    Attributes:
        environment: its environment.
        folder: where the experiment looks for it.
        profile: with which to build it.
    """

    environment: str
    folder: Path
    profile: Profile

    @property
    def command(self) -> str:
        """The command that builds it."""
        return f"tcmrl-data build {self.environment} --profile {self.profile} --out {self.folder}"


def missing_datasets(experiment: Experiment, data: Path) -> list[MissingDataset]:
    """The datasets of an experiment that do not exist.

    Args:
        experiment: the experiment.
        data: folder of datasets, one per environment; or one dataset.
    """
    return [
        MissingDataset(environment, folder, _profile_to_build(choice))
        for environment, choice in experiment.environments.items()
        if not _is_dataset(folder := _folder(environment, choice, data))
    ]


def build_missing(
    missing: MissingDataset, *, workers: int | None, report: Callable[[BuildEvent], None]
) -> None:
    """Builds a dataset that an experiment needs; a build that was stopped goes on.

    Args:
        missing: the dataset.
        workers: processes; one per core where None.
        report: called as the build proceeds.

    Raises:
        TcmrlError: it cannot be built.
        TrainingError: some of its parts failed.
    """
    recipe = load_recipe(missing.environment, profile=missing.profile)
    built = build_dataset(recipe, missing.folder, workers=workers, progress=report)
    if built.failed:
        raise TrainingError(f"{missing.folder}: {built.failed[0]}; build it with `{missing.command}`")


def open_datasets(experiment: Experiment, data: Path) -> dict[str, Dataset]:
    """The dataset of every environment.

    Raises:
        SelectionError: a dataset is missing, of another environment or profile, or without test tasks; of
            missing ones all commands are named.
    """
    missing = missing_datasets(experiment, data)
    if missing:
        commands = "; ".join(f"`{absent.command}`" for absent in missing)
        folders = ", ".join(str(absent.folder) for absent in missing)
        raise SelectionError(
            f"experiment {experiment.name!r}: no dataset at {folders}; build with {commands}, let --build do "
            "it, or say with --data where it lies"
        )
    return {
        environment: _opened(environment, choice, data)
        for environment, choice in experiment.environments.items()
    }


def fold_datasets(dataset: Dataset, views: Path, folds: int | None) -> dict[int | None, Dataset]:
    """Views of a dataset by fold, in which that fold of the tasks is the test split; itself without folds.

    Args:
        dataset: the dataset.
        views: folder in which one view file per fold is made, unless it is there.
        folds: number of folds.

    Raises:
        SelectionError: so many folds that a split would lack tasks.
        StoreError: the folder holds folds of other data.
    """
    if folds is None:
        return {None: dataset}
    made = split_dataset(dataset, views / folder_name(dataset.name), folds=folds, views=True)
    return {fold: open_dataset(view.out) for fold, view in enumerate(made)}


def _folder(environment: str, choice: EnvironmentChoice, data: Path) -> Path:
    if _is_dataset(data):
        return data
    return Path(choice.dataset) if choice.dataset else data / environment


def _is_dataset(path: Path) -> bool:
    """Whether it is a dataset's folder or a view file."""
    return path.is_file() if is_view_file(path) else (path / "manifest.json").is_file()


def _profile_to_build(choice: EnvironmentChoice) -> Profile:
    if choice.dataset_profile is not None:
        return choice.dataset_profile
    for profile in ("quick", "reduced"):
        if choice.profile == profile:
            return profile
    return "paper"


def _opened(environment: str, choice: EnvironmentChoice, data: Path) -> Dataset:
    folder = _folder(environment, choice, data)
    dataset = open_dataset(folder)
    if dataset.name != environment:
        raise SelectionError(f"{folder} holds {dataset.name!r}, the experiment needs {environment!r}")
    found, needed = dataset.manifest.profile, choice.dataset_profile
    if needed not in (None, found) and folder != data:
        raise SelectionError(
            f"{folder} holds a build of profile {found!r}, the experiment needs {needed!r}; name a folder of "
            f"such builds with --data, or this very dataset (--data {folder}) to use it nevertheless"
        )
    if not dataset.test_tasks or len(dataset.train_tasks) < 2:
        raise SelectionError(
            f"{folder} holds {len(dataset.train_tasks)} training and {len(dataset.test_tasks)} test tasks, "
            f"an experiment needs 2 and 1; extend it with `tcmrl-data build {environment} --tasks`"
        )
    return dataset


def plan_runs(
    experiment: Experiment,
    *,
    data: Path,
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
        experiment: the file.
        data: folder of datasets, one per environment; or one dataset, whatever the file says of its place.
        out: the results folder. View files of folds are written there, after all else was checked.
        environments: instead of all of the experiment's.
        seeds: instead of the experiment's.
        steps: training steps instead of `run.steps`, of runs and schedules.
        overrides: `section.key=value` texts for all runs, which the experiment's own changes go over.
        tuned: settings of environments and algorithms, which methods' own changes go over; the training
            table's for what it does not have, or where None.
        threads, device: of every run.

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
