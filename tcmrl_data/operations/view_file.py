"""Writing views."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.view import VIEW_SCHEMA, ViewedParts, is_view_file
from tcmrl_data.foundation.canonical import canonical_json, digest, parse_json
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.records import write_ranges
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.manifest import MANIFEST, Derivation
from tcmrl_data.store.sealing import totals_of


def write_view(
    file: Path,
    source: Dataset,
    keys: Iterable[PartKey],
    *,
    derivation: Derivation,
    label: str | None,
) -> None:
    """Writes a view.

    Args:
        file: of the view; its name ends in `.json`.
        source: the dataset, or a view of it.
        keys: parts of the source, at least one.
        derivation: how they were chosen.
        label: the view's own name.

    Raises:
        StoreError: the file exists, its name is none for a view, or the view would be too large.
    """
    if not is_view_file(file):
        raise StoreError(f"--view {file}: a view is a file whose name ends in .json, and is not {MANIFEST}")
    if os.path.lexists(file):
        raise StoreError(f"--view {file} exists; choose another name or remove it")
    chosen = set(keys)
    table = source.parts.only(chosen)
    fields = {
        "schema_version": VIEW_SCHEMA,
        "source": os.path.relpath(source.folder.resolve(), file.parent.resolve()),
        "source_root": source.sealed_root,
        "label": label,
        "derivation": derivation.model_dump(mode="json"),
        "totals": totals_of(table).model_dump(),
        "root": table.root,
        "parts": [group.model_dump(mode="json") for group in _groups(chosen)],
    }
    data = canonical_json(fields | {"digest": digest(fields)})
    try:
        parse_json(data)
    except ValueError as error:
        raise StoreError(f"--view {file}: too many parts for a view ({error}); use --out instead") from None
    replace_file(file, data)


def _groups(keys: set[PartKey]) -> Iterator[ViewedParts]:
    steps: dict[tuple[str, int], list[int]] = {}
    for key in sorted(keys):
        steps.setdefault((key.run, key.task), []).append(key.step)
    tasks: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for (run, task), members in steps.items():
        tasks.setdefault((run, tuple(members)), []).append(task)
    for (run, common), alike in sorted(tasks.items()):
        yield ViewedParts(tasks=write_ranges(alike), steps=common, run=run)
