"""Datasets as a stranger may write them, with consistent digests, so that only the forgery can be found."""

import json
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load, save

from tcmrl_data import BuildReport, open_dataset
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.records import canonical_json, digest, sealed, sha256
from tcmrl_data.store.archive import Archive, pack_archive
from tcmrl_data.store.arrays import array_digests, encode_arrays, read_arrays
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part import RECORD
from tcmrl_data.store.part_table import (
    HEADER,
    PARTS_TABLE,
    REFERENCES,
    STATISTICS,
    PartEntry,
    parse_parts,
    part_line,
)
from tcmrl_data.store.tables import PARTS, TASKS, PartKey, part_file, seal_of, task_line

FORGED_TASKS, STEP = (0, 3), 150
PART = part_file(PartKey(0, STEP))
OTHER = part_file(PartKey(3, STEP))
Values = dict[str, Any]


class Forge:
    """A dataset of two parts whose files and digests the tests forge.

    Members of the part's archive are named without the folder of the arrays: `rewards/c/0`, `policy.json`.

    Attributes:
        folder: the dataset.
        outside: a folder that nothing may read.
        marker: a file that exists only if code of the dataset ran.
        part: archive of the part that is forged.
    """

    def __init__(self, folder: Path, outside: Path) -> None:
        self.folder, self.outside, self.marker = folder, outside, outside.parent / "code-ran"
        self.part = folder / PART

    def members(self) -> dict[str, bytes]:
        """The members of the part's archive under their full names."""
        with zipfile.ZipFile(self.part) as archive:
            return {name: archive.read(name) for name in archive.namelist()}

    def read(self, name: str) -> bytes:
        """A member of the part."""
        return self.members()[_member(name)]

    def write(self, name: str, data: bytes) -> None:
        """Replaces or adds a member of the part; the tables then agree with it."""
        self.archive(pack_archive({**self.members(), _member(name): data}))

    def take(self, name: str) -> None:
        """Takes a member out of the part; the part's record still calls for it."""
        self.archive(
            pack_archive({key: data for key, data in self.members().items() if key != _member(name)})
        )

    def archive(self, data: bytes) -> None:
        """Replaces the part's file; the tables then agree with it."""
        self.part.write_bytes(data)
        self._describe(size=len(data), sha256=sha256(data))

    def record(self, change: Callable[[Values], object], *, text: Callable[[str], str] = str) -> None:
        """Changes `part.json`, its id and what the tables say of it."""
        values = json.loads(self.read(RECORD))
        change(values)
        values["id"] = digest(values["identity"])
        self.write(RECORD, text(canonical_json(values).decode()).encode())
        told = {name: values["statistics"].get(name) for name in STATISTICS}
        self._describe(
            id=values["id"], **told, **{name: values["references"].get(name) for name in REFERENCES}
        )

    def manifest(self, change: Callable[[Values], object]) -> None:
        """Changes `manifest.json` and its digest."""
        file = self.folder / MANIFEST
        values = json.loads(file.read_bytes())
        change(values)
        values.pop("digest", None)
        file.write_bytes(sealed(values))

    def text(self, old: bytes, new: bytes, file: str = MANIFEST) -> None:
        """Changes a file's bytes and no digest."""
        path = self.folder / file
        assert old in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(old, new, 1))

    def rows(self, table: str, change: Callable[[list[Any]], object]) -> None:
        """Changes the lines of a table; the first one of `parts.jsonl` names the columns."""
        lines = [json.loads(line) for line in (self.folder / table).read_bytes().splitlines()]
        change(lines)
        self.table(table, b"".join(map(canonical_json, lines)))

    def table(self, table: str, data: bytes, **lies: int) -> None:
        """Replaces a table, and makes the manifest agree with it but for the stated fields of its seal."""
        (self.folder / table).write_bytes(data)
        field = table.removesuffix(".jsonl")
        self.manifest(lambda values: values.update({field: seal_of(data).model_dump() | lies}))
        if table == PARTS_TABLE:
            try:
                parts = parse_parts(data, self.folder / table)
            except ManifestError:
                return
            totals = {name: parts.total(name) for name in ("episodes", "steps")}
            totals |= {"parts": len(parts), "bytes": parts.total("size")}
            self.manifest(lambda values: values.update(totals=totals, root=parts.root))

    def cell(self, row: int, column: str, value: Any) -> None:
        """Changes a value of `parts.jsonl`; row 0 is the first part."""
        place = PartEntry._fields.index(column)
        self.rows(PARTS_TABLE, lambda rows: rows[row + 1].__setitem__(place, value))

    def zarr(self, array: str, **fields: Any) -> None:
        """Changes an array's `zarr.json`."""
        values = json.loads(self.read(f"{array}/zarr.json")) | fields
        self.write(f"{array}/zarr.json", json.dumps(values).encode())

    def lengthen(self, num_rows: int) -> None:
        """Sets the number of steps in every array and every record; chunks stay unchanged."""
        arrays = json.loads(self.read(RECORD))["identity"]["arrays"]
        for name, array in arrays.items():
            if name != "episode_offsets":
                shape = [num_rows + 6 * (name == "observations"), *array["shape"][1:]]
                grid = {"name": "regular", "configuration": {"chunk_shape": shape}}
                self.zarr(name, shape=shape, chunk_grid=grid)
                self.record(lambda values, n=name, s=shape: values["identity"]["arrays"][n].update(shape=s))

    def values(self, name: str, change: Callable[[npt.NDArray[Any]], object]) -> None:
        """Replaces an array's values and all digests, as if a rollout had returned them."""
        with Archive(self.part) as archive:
            array = read_arrays(archive, [name])[name].copy()
        change(array)
        self.encode({name: array})

    def encode(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Replaces arrays of one chunk and their digests."""
        files = encode_arrays(arrays)
        self.archive(pack_archive({**self.members(), **{k: v for k, v in files.items() if k.count("/") > 1}}))
        self.record(lambda values: values["identity"]["arrays"].update(array_digests(arrays)))

    def policy(self, **fields: Any) -> None:
        """Changes `policy.json`."""
        self.write("policy.json", canonical_json(json.loads(self.read("policy.json")) | fields))

    def weights(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Changes the tensors."""
        tensors = {name: tensor.copy() for name, tensor in load(self.read("policy.safetensors")).items()}
        change(tensors)
        self.write("policy.safetensors", save(tensors))

    def header(self, change: Callable[[Values], object]) -> None:
        """Changes the header of the safetensors file; its data stay unchanged."""
        data = self.read("policy.safetensors")
        end = 8 + int.from_bytes(data[:8], "little")
        values = json.loads(data[8:end])
        change(values)
        text = json.dumps(values).encode()
        self.write("policy.safetensors", struct.pack("<Q", len(text)) + text + data[end:])

    def payload(self) -> bytes:
        """A pickle that writes the marker file when it is read."""
        marker = str(self.marker)

        class Bomb:
            def __reduce__(self) -> tuple[Any, ...]:
                return open, (marker, "w")

        return pickle.dumps(Bomb())

    def _describe(self, **fields: Any) -> None:
        """Changes the forged part's line of the table."""

        def change(rows: list[Any]) -> None:
            for name, value in fields.items():
                rows[1][PartEntry._fields.index(name)] = value

        self.rows(PARTS_TABLE, change)


def base(tiny: Path, folder: Path, *, keys: Iterable[PartKey] | None = None) -> Path:
    """Parts of the tiny dataset as a complete dataset, with its tables in order of their keys."""
    dataset = open_dataset(tiny)
    chosen = sorted(keys or (PartKey(task, STEP) for task in FORGED_TASKS))
    for key in chosen:
        (folder / part_file(key)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(dataset.file_of(key), folder / part_file(key))
    shutil.copy(tiny / MANIFEST, folder / MANIFEST)
    forge = Forge(folder, folder)
    steps = sorted({key.step for key in chosen})
    tasks = [dataset.task(index) for index in sorted({key.task for key in chosen})]
    forge.manifest(lambda values: values["runs"][0].update(steps=steps))
    forge.table(TASKS, b"".join(map(task_line, tasks)))
    forge.table(PARTS_TABLE, HEADER + b"".join(part_line(dataset.entry(key)) for key in chosen))
    return folder


def copies_of(sound: Path) -> Callable[..., BuildReport]:
    """A build that takes the parts from a sound dataset; what is made again is tested elsewhere."""

    def build(recipe: object, out: Path, **options: object) -> BuildReport:
        for file in (sound / PARTS).rglob("*.zip"):
            (out / file.relative_to(sound)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, out / file.relative_to(sound))
        return BuildReport(out, 0, 0, (), 0.0, "", False)

    return build


def rle_frame(num_bytes: int, *, declared: int | None = None) -> bytes:
    """A zstd frame of zeros in run-length blocks of 128 KiB, and the checksum that Zarr puts behind it."""
    blocks = []
    for start in range(0, num_bytes, 2**17):
        size = min(2**17, num_bytes - start)
        is_last = start + size == num_bytes
        blocks.append(struct.pack("<I", is_last | 1 << 1 | size << 3)[:3] + b"\0")
    size_field = struct.pack("<Q", num_bytes if declared is None else declared)
    return with_checksum(b"\x28\xb5\x2f\xfd\xe0" + size_field + b"".join(blocks))


def with_checksum(data: bytes) -> bytes:
    """Bytes with the CRC-32C that Zarr's codec expects."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return data + struct.pack("<I", crc ^ 0xFFFFFFFF)


def offsets(values: list[int]) -> dict[str, npt.NDArray[Any]]:
    """`episode_offsets` of given values."""
    return {"episode_offsets": np.array(values, dtype=np.int64)}


def _member(name: str) -> str:
    return name if name.startswith(("policy.", RECORD)) else f"arrays/{name}"
