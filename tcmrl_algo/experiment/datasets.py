"""The datasets of an experiment: found, built where they are missing, and cut into folds."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.experiment.spec import EnvironmentChoice, Experiment, folder_name
from tcmrl_data import (
    BuildEvent,
    Dataset,
    Profile,
    SelectionError,
    TrainingError,
    build_dataset,
    is_view_file,
    load_recipe,
    open_dataset,
    split_dataset,
)


@dataclass(frozen=True)
class MissingDataset:
    """A dataset that an experiment needs and that does not exist."""

    environment: str
    folder: Path
    profile: Profile

    @property
    def command(self) -> str:
        """The command that builds it."""
        return f"tcmrl-data build {self.environment} --profile {self.profile} --out {self.folder}"


def missing_datasets(experiment: Experiment, data: Path | None = None) -> list[MissingDataset]:
    """The datasets of an experiment that do not exist; `data` as for `run_experiment`."""
    return [
        MissingDataset(environment, folder, _profile_to_build(choice))
        for environment, choice in experiment.environments.items()
        if not _is_dataset(folder := _folder(environment, choice, data))
    ]


def build_missing(
    missing: MissingDataset, *, workers: int | None, report: Callable[[BuildEvent], None]
) -> None:
    """Builds a dataset that an experiment needs; a build that was stopped goes on."""
    recipe = load_recipe(missing.environment, profile=missing.profile)
    built = build_dataset(recipe, missing.folder, workers=workers, progress=report)
    if built.failed:
        raise TrainingError(f"{missing.folder}: {built.failed[0]}; build it with `{missing.command}`")


def open_datasets(experiment: Experiment, data: Path | None = None) -> dict[str, Dataset]:
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
        views: folder in which one view file per fold is made, unless it is there.

    Raises:
        SelectionError: so many folds that a split would lack tasks.
        StoreError: the folder holds folds of other data.
    """
    if folds is None:
        return {None: dataset}
    made = split_dataset(dataset, views / folder_name(dataset.name), folds=folds, views=True)
    return {fold: open_dataset(view.out) for fold, view in enumerate(made)}


def _folder(environment: str, choice: EnvironmentChoice, data: Path | None) -> Path:
    if data is None:
        return Path(choice.dataset or f"data/{environment}")
    return data if _is_dataset(data) else data / environment


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


def _opened(environment: str, choice: EnvironmentChoice, data: Path | None) -> Dataset:
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
