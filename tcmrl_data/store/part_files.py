"""Which files a part consists of, and whether they lie there as recorded; contents are not read."""

import os
from collections.abc import Iterator, Sequence
from math import prod
from pathlib import Path

from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import file_problem, folder_problem, one_line, words_after
from tcmrl_data.store.layout import ArrayLayout, check_array, check_expansion, check_layout, read_group
from tcmrl_data.store.manifest import FileRecord, Manifest, PartEntry, PartRecord, TaskRecord


def check_files(folder: Path, record: PartRecord) -> list[ArrayLayout]:
    """Checks that a part's files are those of its record, plain and of their sizes; returns its layouts.

    Raises:
        StoreError: names the file.
    """
    layouts = check_layout(
        folder, {name: array.model_dump() for name, array in record.identity.arrays.items()}
    )
    check_expansion(layouts, sum(file.size for file in record.files.values()), folder)
    unknown = unrecorded_file(record, layouts)
    if unknown:
        raise StoreError(f"{folder / 'part.json'}: files does not agree with the arrays on {unknown}")
    for name, expected in record.files.items():
        problem = file_mismatch(folder, name, expected)
        if problem:
            raise StoreError(f"{folder / name} {problem}; run `tcmrl-data repair`")
    return layouts


def unrecorded_file(record: PartRecord, layouts: Sequence[ArrayLayout]) -> str | None:
    """A file that the part's arrays call for and its record leaves out, or the other way round."""
    named = set(record.files)
    for layout in layouts:
        if prod(layout.grid) > len(named):
            return f"{layout.name}/c"
    needed = {"zarr.json", "policy.json"}.union(*(layout.files() for layout in layouts))
    return min((needed ^ named) - {"policy.safetensors"}, default=None)


def file_mismatch(folder: Path, name: str, expected: FileRecord) -> str | None:
    """Why a recorded file is not what it must be, its content aside; None where it is."""
    blocked = folder_problem(folder, os.path.dirname(name))
    if blocked:
        return f"cannot be reached: {blocked[0]} {blocked[1]}"
    try:
        status = os.lstat(os.path.join(folder, name))
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return one_line(error)
    problem = file_problem(status)
    if problem is None and status.st_size != expected.size:
        problem = f"has {status.st_size} bytes instead of {expected.size}"
    return problem


def layout_problems(folder: Path, record: PartRecord) -> Iterator[tuple[str, str]]:
    """Everything that `check_files` would refuse of a part's layout: file within the part, and problem."""
    layouts = []
    try:
        read_group(folder / "zarr.json")
    except StoreError as error:
        yield "zarr.json", words_after(error, folder / "zarr.json")
    for name, array in record.identity.arrays.items():
        try:
            layouts.append(check_array(folder, name, array.model_dump()))
        except StoreError as error:
            yield f"{name}/zarr.json", words_after(error, folder / name / "zarr.json")
    if len(layouts) < len(record.identity.arrays):
        return
    unknown = unrecorded_file(record, layouts)
    if unknown:
        yield "part.json", f"files does not agree with the arrays on {unknown}"
    try:
        check_expansion(layouts, sum(file.size for file in record.files.values()), folder)
    except StoreError as error:
        yield "", words_after(error, folder)


def identity_problems(
    record: PartRecord, sealed: str, *, entry: PartEntry, task: TaskRecord, manifest: Manifest
) -> Iterator[str]:
    """How a part's record differs from what the manifest says of it.

    Args:
        record: the part's record.
        sealed: sha256 of `part.json`.
        entry: the part in the manifest.
        task: its task in the manifest.
        manifest: the dataset's manifest.
    """
    identity = record.identity
    if sealed != entry.sha256:
        yield "is not the record that the manifest names"
    for name, found, wanted in (
        ("id", record.id, entry.id),
        ("identity.task", identity.task, entry.task),
        ("identity.step", identity.step, entry.step),
        ("identity.seed", identity.seed, manifest.seed),
        ("identity.data_version", identity.data_version, manifest.data_version),
        ("identity.parameters", identity.parameters, task.parameters),
        ("identity.settings", identity.settings, manifest.recipe.unit_settings()),
    ):
        if found != wanted:
            yield f"{name} is not the manifest's"
