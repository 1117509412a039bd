"""Writing the tables and the manifest of a dataset whose parts are published."""

from collections.abc import Collection, Sequence
from pathlib import Path

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.records import sealed
from tcmrl_data.store.manifest import (
    MANIFEST_SCHEMA,
    Derivation,
    Manifest,
    Run,
    TableSeal,
    Totals,
    read_manifest,
    write_manifest,
)
from tcmrl_data.store.part_table import HEADER, PARTS_TABLE, PartTable, part_line
from tcmrl_data.store.platform import Platform
from tcmrl_data.store.tables import seal_of
from tcmrl_data.store.task_table import TASKS, task_line


def totals_of(table: PartTable) -> Totals:
    """The sums over the parts of a table."""
    return Totals(
        parts=len(table),
        episodes=table.total("episodes"),
        steps=table.total("steps"),
        bytes=table.total("size"),
    )


def write_dataset(
    folder: Path,
    *,
    name: str,
    label: str | None,
    data_version: int,
    runs: Sequence[Run],
    derivation: Derivation | None,
    platforms: Sequence[Platform],
    tasks: Sequence[Task],
    dropped: Collection[int] = (),
    table: PartTable,
) -> Manifest:
    """Writes the tables and then the manifest that seals them; the dataset exists from then on.

    Args:
        folder: the dataset, where the parts of the table are.
        name: the environment's name.
        label: the dataset's own name.
        data_version: of the parts.
        runs: how the parts were made; the first has a recipe.
        derivation: how the dataset was derived from others.
        platforms: of the parts; the table refers to them by position.
        tasks: all tasks, dropped ones too.
        dropped: indices of tasks that do not belong to the dataset.
        table: all parts.

    Raises:
        StorageError: the operating system refuses an operation.
    """
    tables = {
        TASKS: b"".join(task_line(task) for task in sorted(tasks, key=lambda task: task.index)),
        PARTS_TABLE: HEADER + b"".join(map(part_line, table.entries())),
    }
    for file, lines in tables.items():
        replace_file(folder / file, lines, staging=folder / STAGING)
    data = manifest_bytes(
        name=name,
        label=label,
        data_version=data_version,
        runs=runs,
        derivation=derivation,
        platforms=platforms,
        tasks=seal_of(tables[TASKS]),
        parts=seal_of(tables[PARTS_TABLE]),
        dropped=dropped,
        kept=table.without_tasks(dropped),
    )
    write_manifest(folder, data)
    return read_manifest(folder)


def manifest_bytes(
    *,
    name: str,
    label: str | None,
    data_version: int,
    runs: Sequence[Run],
    derivation: Derivation | None,
    platforms: Sequence[Platform],
    tasks: TableSeal,
    parts: TableSeal,
    dropped: Collection[int],
    kept: PartTable,
) -> bytes:
    """The file of a manifest.

    Args:
        name: the environment's name.
        label: the dataset's own name.
        data_version: of the parts.
        runs: how the parts were made.
        derivation: how the dataset was derived from others.
        platforms: of the parts.
        tasks: seal of the table of all tasks, dropped ones too.
        parts: seal of the table of all parts.
        dropped: indices of tasks that do not belong to the dataset.
        kept: the parts of the other tasks.
    """
    fields = {
        "schema_version": MANIFEST_SCHEMA,
        "name": name,
        "label": label,
        "data_version": data_version,
        "runs": [run.model_dump(mode="json") for run in runs],
        "derivation": None if derivation is None else derivation.model_dump(mode="json"),
        "platforms": [platform.model_dump(mode="json") for platform in platforms],
        "tasks": tasks.model_dump(),
        "parts": parts.model_dump(),
        "dropped": sorted(dropped),
        "totals": totals_of(kept).model_dump(),
        "root": kept.root,
        "complete": is_complete(kept, runs, num_tasks=tasks.lines - len(dropped)),
    }
    return sealed(fields)


def is_complete(table: PartTable, runs: Sequence[Run], *, num_tasks: int) -> bool:
    """Whether every task has the snapshots that the runs plan.

    Args:
        table: parts of the tasks that belong to the dataset.
        runs: of the dataset.
        num_tasks: number of those tasks.
    """
    return all(
        table.num_parts(run.name) == len(run.steps) * num_tasks for run in runs if run.steps is not None
    )
