"""The viewer's Parquet beside a card: what Hugging Face shows and `datasets.load_dataset` reads of a dataset.

```
viewer/train/task_00000.parquet …               transitions, as the Parquet export writes them
viewer/train/{tasks, parts, episodes}.parquet   a row per task, part and episode
viewer/test/…                                   the same of test tasks
```

The front matter of the card names them as the configurations `transitions`, `tasks`, `parts` and `episodes`,
each with its splits.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tcmrl_data.building.work_files import VIEWER
from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.describe.croissant import part_row
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.exporting import export_dataset
from tcmrl_data.interchange.parquet import (
    ParquetFormat,
    dataset_root,
    episode_rows,
    parameter_columns,
    table_bytes,
)

FILES = {
    "transitions": f"task_*{ParquetFormat.suffix}",
    **{name: f"{name}{ParquetFormat.suffix}" for name in ("episodes", "parts", "tasks")},
}
"""Of a split, by configuration."""


def viewer_configs(dataset: Dataset) -> list[dict[str, Any]]:
    """The configurations as front matter, with the splits that the dataset has."""
    return [
        {
            "config_name": name,
            **({"default": True} if name == "transitions" else {}),
            "data_files": [
                {"split": split, "path": f"{VIEWER}/{split}/{files}"} for split in _tasks_by_split(dataset)
            ],
        }
        for name, files in FILES.items()
    ]


def write_viewer(
    dataset: Dataset, folder: Path, *, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Writes the viewer's files into a folder, the card's, and returns where they are.

    Transitions that are there of the same data stay; the small tables are written anew.

    Raises:
        StoreError: there are transitions of other data.
        MissingPackageError: pyarrow is not installed.
        StorageError: the operating system refuses the operation.
    """
    out = folder / VIEWER
    written = sorted(out.glob(f"*/{FILES['transitions']}"))
    if not written:
        export_dataset(dataset, ParquetFormat.name, out, progress=progress)
    elif any(dataset_root(file) != dataset.manifest.root for file in written):
        raise StoreError(f"{out} holds transitions of other data; remove it, then write the card again")
    for split, tasks in _tasks_by_split(dataset).items():
        entries = (entry for task in tasks for entry in dataset.parts.entries_of(task.index))
        tables = {
            "tasks": [{"task": task.index, "split": split, **parameter_columns(task)} for task in tasks],
            "parts": [{"split": split, **part_row(entry)} for entry in entries],
            "episodes": episode_rows(sorted((out / split).glob(FILES["transitions"]))),
        }
        for name, rows in tables.items():
            replace_file(out / split / FILES[name], table_bytes(rows))
    return out


def _tasks_by_split(dataset: Dataset) -> dict[str, Sequence[Task]]:
    splits = {"train": dataset.train_tasks, "test": dataset.test_tasks}
    return {split: tasks for split, tasks in splits.items() if tasks}
