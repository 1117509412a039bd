"""The layout of parts before archives, kept to measure against it: one folder a part, 16 files, each synced.

What `store.py` compares is done as it was done then: publishing synced every file and folder, opening read
and validated every `part.json`, looked at every file and checked every `zarr.json`, and arrays were read
file by file.
"""

import os
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from tcmrl_data.foundation.canonical import canonical_json, digest, parse_json, sha256
from tcmrl_data.foundation.disk import disk
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.plain_files import file_problem, folder_problem, read_plain_file
from tcmrl_data.foundation.records import Record, _with_tuples
from tcmrl_data.sampling.rows import READERS, ROW_ARRAYS, Table, fill_rows
from tcmrl_data.store.arrays import ARRAYS, _decode_chunk, _parse_layout, chunk_problem
from tcmrl_data.store.arrays import ArrayLayout as Layout
from tcmrl_data.store.part import RECORD, PartRecord
from tcmrl_data.store.tables import SHA256

_FILE_NAME = re.compile(
    r"policy\.(json|safetensors)|zarr\.json|[a-z0-9_]{1,64}/(zarr\.json|c(/[0-9]{1,9}){1,2})"
)


class FileRecord(Record):
    """Size in bytes and sha256 of a file."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern=SHA256)


class FolderRecord(PartRecord):
    """`part.json` of a part in a folder."""

    files: dict[str, FileRecord]


def folder_files(archive_files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files of a part's folder but for `part.json`, from the members of its archive."""
    names = {name: name.removeprefix(f"{ARRAYS}/") for name in archive_files if name != RECORD}
    return {name: archive_files[member] for member, name in names.items()}


def publish_folder(target: Path, record: PartRecord, files: Mapping[str, bytes]) -> None:
    """Hashes the files, writes them and `part.json` beside the target, syncs each, and renames the folder."""
    hashes = {name: {"size": len(data), "sha256": sha256(data)} for name, data in files.items()}
    sealed = canonical_json(record.model_dump(mode="json") | {"files": hashes})
    staged = target.with_name(f".{target.name}")
    everything = {**files, RECORD: sealed}
    folders = {staged, *(staged / parent for name in everything for parent in Path(name).parents)}
    for folder in sorted(folders):
        disk.make_folder(folder)
    for name, data in everything.items():
        disk.write(staged / name, data)
        disk.sync(staged / name)
    for folder in sorted(folders, reverse=True):
        disk.sync(folder)
    disk.rename(staged, target)
    disk.sync(target.parent)


def open_folders(folder: Path, places: Sequence[str]) -> list[FolderRecord]:
    """Opens a dataset's parts: the records, after every check that opening made."""
    return [_open_folder(folder, place) for place in places]


def hash_folders(folder: Path, records: Mapping[str, FolderRecord]) -> None:
    """Hashes every file of parts in one thread, as resuming a build did."""
    for place, record in records.items():
        for name, expected in record.files.items():
            assert sha256(read_plain_file(folder / place / name, limit=2**40)) == expected.sha256


def read_folder_rows(folder: Path, places: Sequence[str], records: Sequence[FolderRecord]) -> Table:
    """The rows of parts, as `read_rows` makes them."""
    shapes = [{name: array.shape for name, array in record.identity.arrays.items()} for record in records]
    lengths = [shape["observations"][0] for shape in shapes]
    ends = np.cumsum(lengths)
    width = shapes[0]["observations"][1] + shapes[0]["actions"][1] + 2
    table: Table = np.zeros((int(ends[-1]) + max(lengths), width), dtype=np.float32)

    def read(place: str, first: int, last: int) -> None:
        fill_rows(table[first:last], _read_arrays(folder / place, ROW_ARRAYS))

    with ThreadPoolExecutor(min(READERS, available_cores())) as pool:
        list(pool.map(read, places, ends - lengths, ends))
    return table


def _open_folder(folder: Path, place: str) -> FolderRecord:
    assert folder_problem(folder, place) is None
    path = folder / place
    data = read_plain_file(path / RECORD, limit=2**18)
    values = parse_json(data)
    text = canonical_json(values)
    FolderRecord.model_validate(_with_tuples(values))
    record = FolderRecord.model_validate_json(text)
    assert record.id == digest(values["identity"])
    assert all(_FILE_NAME.fullmatch(name) for name in record.files)
    sha256(data)  # compared with the manifest's
    read_plain_file(path / "zarr.json", limit=2**16)
    needed = {"zarr.json", "policy.json"}
    for name, array in record.identity.arrays.items():
        layout = _layout(path, name)
        assert (layout.dtype, layout.shape) == (array.dtype, array.shape)
        needed.update(file.removeprefix(f"{ARRAYS}/") for file in layout.files())
    assert (needed ^ set(record.files)) <= {"policy.safetensors"}
    for name, expected in record.files.items():
        assert folder_problem(path, os.path.dirname(name)) is None
        status = os.lstat(os.path.join(path, name))
        assert file_problem(status) is None and status.st_size == expected.size
    return record


def _layout(path: Path, name: str) -> Layout:
    assert folder_problem(path, name) is None
    return _parse_layout(name, read_plain_file(path / name / "zarr.json", limit=2**16))


def _read_arrays(path: Path, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """Arrays of one chunk each."""
    arrays = {}
    for name in names:
        layout = _layout(path, name)
        (chunk,) = layout.files()[1:]
        data = read_plain_file(path / chunk.removeprefix(f"{ARRAYS}/"), limit=2**30)
        assert chunk_problem(layout, data) is None
        arrays[name] = np.empty(layout.shape, dtype=layout.dtype)
        _decode_chunk(data, arrays[name])
    return arrays
