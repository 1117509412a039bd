"""Which datasets lie below a folder."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
