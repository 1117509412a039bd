"""Which datasets lie below a folder, and a dataset on one screen."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.disk import STAGING
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.store.keys import PARTS
from tcmrl_data.store.manifest import MANIFEST, Manifest, read_manifest


def list_datasets(root: str | Path) -> list[dict[str, Any]]:
    """The datasets below a folder: name, tasks, parts, complete, root, path; unreadable ones with `error`."""
    rows: list[dict[str, Any]] = []
    for file in sorted(_manifests(Path(root))):
        try:
            manifest = read_manifest(file)
        except ManifestError as error:
            rows.append({"path": str(file.parent), "error": str(error)})
            continue
        rows.append(dataset_row(manifest, file.parent))
    return rows


def _manifests(root: Path) -> Iterator[Path]:
    """The manifests below a folder."""
    for folder, inner, files in os.walk(root):
        is_dataset = MANIFEST in files
        if is_dataset:
            yield Path(folder, MANIFEST)
        # in staging are parts on their way, such as those that a repair makes again; archives are many
        inner[:] = [name for name in inner if name != STAGING and not (is_dataset and name == PARTS)]


def dataset_row(manifest: Manifest, folder: Path) -> dict[str, Any]:
    """What a dataset's manifest says in short."""
    return {
        "path": str(folder),
        "name": manifest.name,
        "profile": manifest.profile,
        "behavior": manifest.recipe.behavior.source,
        "seed": manifest.seed,
        "tasks": manifest.num_tasks,
        "parts": manifest.totals.parts,
        "complete": manifest.complete,
        "root": manifest.root,
    }


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
