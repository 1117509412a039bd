"""Writing the tables of a dataset again, from the parts or with other lines for some of them."""

import contextlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from tcmrl_data.envs.base import Task, draw_tasks
from tcmrl_data.foundation.errors import BuildError, ManifestError, StoreError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.parts.making import Published, numbered, read_published
from tcmrl_data.recipe.recipe import choose_tasks
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, Manifest, write_dataset
from tcmrl_data.store.part import Platform
from tcmrl_data.store.part_table import PARTS_TABLE, PartTable, parse_entries, parse_parts
from tcmrl_data.store.tables import (
    TASKS,
    PartKey,
    key_of_file,
    parse_tasks,
    part_file,
    read_lines,
    read_sealed,
)
from tcmrl_data.verification.contents import recipe_environment
from tcmrl_data.verification.description import scan_dataset


def restore_tables(folder: Path, manifest: Manifest) -> None:
    """Writes damaged tables again, from the parts and the recipe.

    Raises:
        BuildError: what was found does not have the manifest's root, or not its number of tasks; nothing was
            written.
    """
    platforms = list(manifest.platforms)
    try:
        table = parse_parts(read_sealed(folder / PARTS_TABLE, manifest.parts), folder / PARTS_TABLE)
    except ManifestError:
        table = _recover_parts(folder, manifest, platforms)
    try:
        tasks = parse_tasks(read_sealed(folder / TASKS, manifest.tasks), folder / TASKS)
    except ManifestError:
        tasks = _draw_again(table, manifest)
    if len(tasks) != manifest.tasks.lines or table.without_tasks(manifest.dropped).root != manifest.root:
        raise BuildError(
            f"{folder}: its tables are damaged, and what its parts tell does not have the manifest's root; "
            f"delete {MANIFEST} and {MANIFEST_COPY} and run the first `tcmrl-data build` again, which keeps "
            "the sound parts"
        )
    write_tables(folder, manifest, tasks=tasks, table=table, platforms=platforms)


def write_tables(
    folder: Path,
    manifest: Manifest,
    *,
    tasks: Sequence[Task],
    table: PartTable,
    platforms: Sequence[Platform],
) -> None:
    """Replaces the tables and then the manifest that seals them.

    If this is interrupted the tables are not those of the manifest, and `restore_tables` finds them again.
    """
    write_dataset(
        folder,
        name=manifest.name,
        label=manifest.label,
        data_version=manifest.data_version,
        runs=manifest.runs,
        derivation=manifest.derivation,
        platforms=platforms,
        tasks=tasks,
        dropped=manifest.dropped,
        table=table,
    )


def _recover_parts(folder: Path, manifest: Manifest, platforms: list[Platform]) -> PartTable:
    """The table that has the manifest's root, of sound parts and of sound lines; the last if none has it.

    A damaged part stands in its line alone. A sound part without a line may not be recorded yet.
    """
    sound = {entry.key: entry for entry in numbered(_read_parts(folder), platforms)}
    lines = b""
    with contextlib.suppress(ManifestError):  # no plain file at all
        lines = read_lines(folder / PARTS_TABLE, manifest.parts.bytes)
    recorded = {
        entry.key: entry
        for line in lines.splitlines(keepends=True)
        for entry in parse_entries(line)
        if entry.platform < len(manifest.platforms)
    }
    in_lines = {key: sound.get(key, entry) for key, entry in recorded.items()}
    choices = (recorded | sound, in_lines, sound)
    for entries in choices:
        table = PartTable.empty().with_entries(list(entries.values()))
        if table.without_tasks(manifest.dropped).root == manifest.root:
            break
    return table


def _read_parts(folder: Path) -> list[Published]:
    """All sound parts in a dataset's folder, in order of their keys."""
    keys = sorted(key for key in map(key_of_file, scan_dataset(folder).files) if key is not None)

    def read(key: PartKey) -> Published | None:
        try:
            published = read_published(folder / part_file(key), key.run)[0]
        except (StoreError, ManifestError):
            return None
        return published if published.entry.key == key else None

    with ThreadPoolExecutor(available_cores()) as pool:
        return [part for part in pool.map(read, keys) if part is not None]


def _draw_again(table: PartTable, manifest: Manifest) -> tuple[Task, ...]:
    """The tasks of the parts and of the recipe's choice, as the recipe draws them.

    Their splits are those of the derivation, if it has changed any.

    Raises:
        BuildError: the tasks are not the recipe's.
        ManifestError: the recipe's environment cannot be made, or has more tasks than a dataset may have.
    """
    if not manifest.is_drawn:
        raise BuildError(
            f"{TASKS} is damaged, and nobody can draw the tasks of foreign data; import or record them again"
        )
    recipe = manifest.recipe
    environment = recipe_environment(recipe)
    if isinstance(environment, str):
        raise ManifestError(f"{MANIFEST}: {environment}")
    present = set(table.columns["task"].tolist())
    if len(present) < manifest.tasks.lines:
        present |= {task.index for task in choose_tasks(recipe)}
    splits = manifest.derivation.split_of_tasks() if manifest.derivation else {}
    return tuple(
        replace(task, split=splits.get(task.index, task.split))
        for task in draw_tasks(environment)
        if task.index in present
    )
