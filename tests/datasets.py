"""Views of datasets that tests compare or change."""

from collections.abc import Collection
from pathlib import Path

from tcmrl_data import Dataset, open_dataset


def part_ids(folder: Path) -> dict[tuple[int, int], str]:
    """The ids of a dataset's parts, by task and step."""
    return {(entry.task, entry.step): entry.id for entry in open_dataset(folder).parts.entries()}


def with_tasks(dataset: Dataset, indices: Collection[int]) -> Dataset:
    """The dataset without its other tasks."""
    dropped = tuple(task.index for task in dataset.tasks if task.index not in indices)
    root = dataset.parts.without_tasks(dropped).root
    return Dataset(dataset.folder, dataset.manifest.model_copy(update={"dropped": dropped, "root": root}))
