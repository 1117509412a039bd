"""A dataset on one screen."""

from collections.abc import Iterable
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import dataset_row

MADE_WITH = ("python", "cpu", "platform", "created")


def dataset_summary(dataset: Dataset) -> dict[str, Any]:
    """What a dataset is, how large it is, and with what it was made.

    Returns:
        The row of `list_datasets`, and: `description`; `train` and `test` tasks; steps of `snapshots`;
        `parts_total`, parts when complete; `episodes`, `steps`, `bytes`, of what is there; and under
        `made_with` all values of `packages`, `python`, `cpu`, `platform`, `created` in the parts' records.
    """
    manifest = dataset.manifest
    parts = [dataset.part(entry.task, entry.step) for entry in manifest.parts]
    made = [part.provenance for part in parts]
    return dataset_row(manifest, dataset.folder) | {
        "description": manifest.recipe.about.description,
        "train": len(dataset.train_tasks),
        "test": len(dataset.test_tasks),
        "snapshots": list(manifest.steps),
        "parts_total": len(manifest.tasks) * len(manifest.steps),
        "episodes": sum(part.statistics.episodes for part in parts),
        "steps": sum(part.statistics.steps for part in parts),
        "bytes": sum(file.size for part in parts for file in part.files.values()),
        "made_with": {
            "packages": _distinct(_versions(record.get("packages")) for record in made),
            **{key: _distinct(record.get(key) for record in made) for key in MADE_WITH},
        },
    }


def _versions(packages: Any) -> str | None:
    if not isinstance(packages, dict):
        return None
    return ", ".join(f"{name} {version}" for name, version in sorted(packages.items()))


def _distinct(values: Iterable[Any]) -> list[str]:
    return sorted({value for value in values if isinstance(value, str)})
