"""What exported files say of themselves, and which episodes most formats cannot hold."""

import json
from collections.abc import Sequence
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.recipe.about import AND
from tcmrl_data.store.keys import PartKey


def task_attributes(selection: Selection, task: Task, *, layout: str, version: int) -> dict[str, Any]:
    """Numbers and texts that name the task of a file and the dataset that it came from.

    A dataset without a seed, such as an imported one, has no attribute `seed`.

    Args:
        selection: what is exported.
        task: of the file.
        layout: of the file, such as `tcmrl-hdf5`.
        version: of the layout.
    """
    manifest = selection.dataset.manifest
    attributes = {
        "format": layout,
        "format_version": version,
        "environment": manifest.name,
        "task": task.index,
        "split": task.split,
        "parameters": json.dumps(dict(task.parameters), sort_keys=True),
        "dataset_root": manifest.root,
        "recipe": json.dumps(manifest.recipe.unit_settings(), sort_keys=True),
        "citation": manifest.recipe.about.citation,
        "licence": AND.join(manifest.licences),
    }
    return attributes if manifest.seed is None else attributes | {"seed": manifest.seed}


def stored_episodes(dataset: Dataset, key: PartKey, *, format_name: str) -> Sequence[Trajectory]:
    """The episodes of a part, for a format that cannot hold one without steps.

    Raises:
        StoreError: an episode has no steps.
    """
    trajectories = dataset.trajectories(*key)
    for index, trajectory in enumerate(trajectories):
        if not len(trajectory):
            raise StoreError(
                f"{dataset.file_of(key)}: episode {index} has no steps, which {format_name} cannot hold; "
                "export with --format hdf5"
            )
    return trajectories
