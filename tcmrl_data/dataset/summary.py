"""A dataset on one screen."""

from collections.abc import Iterable
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import dataset_row


def dataset_summary(dataset: Dataset) -> dict[str, Any]:
    """What a dataset is, how large it is, and on what it was made.

    Returns:
        The row of `list_datasets`, and: `description`; `train` and `test` tasks; steps of `snapshots`;
        `parts_total`, parts when complete; `episodes`, `steps`, `bytes`, of what is there; and under
        `made_with` all values of `packages`, `python`, `cpu`, `system` of the platforms.
    """
    manifest = dataset.manifest
    platforms = manifest.platforms
    return dataset_row(manifest, dataset.folder) | {
        "description": manifest.recipe.about.description,
        "train": len(dataset.train_tasks),
        "test": len(dataset.test_tasks),
        "snapshots": sorted(set(dataset.parts.columns["step"].tolist()) | {*(manifest.steps or ())}),
        "parts_total": manifest.num_expected,
        "episodes": manifest.totals.episodes,
        "steps": manifest.totals.steps,
        "bytes": manifest.totals.bytes,
        "made_with": {
            "packages": _distinct(_versions(platform.packages) for platform in platforms),
            "python": _distinct(platform.python for platform in platforms),
            "cpu": _distinct(platform.cpu for platform in platforms),
            "system": _distinct(platform.system for platform in platforms),
        },
    }


def _versions(packages: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in sorted(packages.items()))


def _distinct(values: Iterable[str]) -> list[str]:
    return sorted(set(values))
