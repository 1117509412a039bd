"""Forged datasets for all known attacks, with consistent digests, so that only the attack can be found."""

import json
import os
import pickle
import shutil
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from safetensors.numpy import load, save

from tcmrl_data.foundation.canonical import canonical_json, digest, sha256
from tcmrl_data.store.manifest import MANIFEST, PartEntry, merkle_root, part_folder, seal

TASKS, STEP = (0, 3), 150
PART = part_folder(0, STEP)
OTHER = part_folder(3, STEP)
ESCAPE = "\x1b]0;owned\x07\x1b[2J"
Stage = Literal["open", "read", "verify"]
Values = dict[str, Any]


class Forge:
    """A dataset of two parts whose files and digests the tests forge.

    Attributes:
        folder: the dataset.
        outside: a folder that nothing may read.
        marker: a file that exists only if code of the dataset ran.
    """

    def __init__(self, folder: Path, outside: Path) -> None:
        self.folder, self.outside, self.marker = folder, outside, outside.parent / "code-ran"
        self.part = folder / PART

    def write(self, name: str, data: bytes) -> None:
        """Replaces a file of the part and its entry in the part's record."""
        (self.part / name).write_bytes(data)
        self.record(
            lambda values: values["files"].update({name: {"size": len(data), "sha256": sha256(data)}})
        )

    def rename(self, name: str) -> None:
        """Moves a file out of the part; the part's record still names it."""
        (self.part / name).rename(self.outside / "taken")

    def record(self, change: Callable[[Values], object], *, text: Callable[[str], str] = str) -> None:
        """Changes `part.json`, its id and the manifest."""
        file = self.part / "part.json"
        values = json.loads(file.read_bytes())
        change(values)
        values["id"] = digest(values["identity"])
        file.write_bytes(text(canonical_json(values).decode()).encode())
        self.manifest(lambda manifest: self._name_part(manifest, values["id"], sha256(file.read_bytes())))

    def manifest(self, change: Callable[[Values], object], *, root: bool = True) -> None:
        """Changes `manifest.json` and updates its root."""
        file = self.folder / MANIFEST
        values = json.loads(file.read_bytes())
        change(values)
        values.pop("digest", None)
        if root:
            values["root"] = _root(values["parts"])
        file.write_bytes(seal(values))

    def text(self, old: bytes, new: bytes) -> None:
        """Changes the manifest's bytes without updating its root."""
        file = self.folder / MANIFEST
        assert old in file.read_bytes()
        file.write_bytes(file.read_bytes().replace(old, new, 1))

    def zarr(self, array: str, **fields: Any) -> None:
        """Changes an array's `zarr.json`."""
        values = json.loads((self.part / array / "zarr.json").read_bytes()) | fields
        self.write(f"{array}/zarr.json", json.dumps(values).encode())

    def rows(self, num_rows: int) -> None:
        """Sets the number of steps in every array and every record; chunks stay unchanged."""
        arrays = json.loads((self.part / "part.json").read_bytes())["identity"]["arrays"]
        for name, array in arrays.items():
            if name != "episode_offsets":
                shape = [num_rows + 6 * (name == "observations"), *array["shape"][1:]]
                grid = {"name": "regular", "configuration": {"chunk_shape": shape}}
                self.zarr(name, shape=shape, chunk_grid=grid)
                self.record(lambda values, n=name, s=shape: values["identity"]["arrays"][n].update(shape=s))

    def policy(self, **fields: Any) -> None:
        """Changes `policy.json`."""
        values = json.loads((self.part / "policy.json").read_bytes()) | fields
        self.write("policy.json", canonical_json(values))

    def weights(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Changes the tensors."""
        tensors = {k: v.copy() for k, v in load((self.part / "policy.safetensors").read_bytes()).items()}
        change(tensors)
        self.write("policy.safetensors", save(tensors))

    def header(self, change: Callable[[Values], object]) -> None:
        """Changes the header of the safetensors file; its data stay unchanged."""
        data = (self.part / "policy.safetensors").read_bytes()
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

    @staticmethod
    def _name_part(manifest: Values, part_id: str, sealed: str) -> None:
        entry = next(part for part in manifest["parts"] if part["task"] == TASKS[0])
        entry |= {"id": part_id, "sha256": sealed}


@dataclass(frozen=True)
class Case:
    """One forgery.

    Attributes:
        damage: makes it.
        stage: the first stage that must refuse: opening, reading arrays and policy, or deep verification.
        file: end of the path that the error and a finding must name.
        words: what the error must say, at least the field.
    """

    name: str
    damage: Callable[[Forge], object]
    file: str
    words: str
    stage: Stage = "open"


def base(tiny: Path, folder: Path) -> Path:
    """Two parts of the tiny dataset as a complete dataset."""
    for task in TASKS:
        shutil.copytree(tiny / part_folder(task, STEP), folder / part_folder(task, STEP))
        for parent in Path(part_folder(task, STEP)).parents:
            shutil.copy(tiny / parent / "zarr.json", folder / parent / "zarr.json")
    values = json.loads((tiny / MANIFEST).read_bytes())
    values.pop("digest")
    values |= {"steps": [STEP], "complete": True}
    values["tasks"] = [task for task in values["tasks"] if task["index"] in TASKS]
    values["parts"] = [part for part in values["parts"] if part["task"] in TASKS and part["step"] == STEP]
    values["root"] = _root(values["parts"])
    values["references"] = {
        str(task): record["references"] | {"behavior": record["statistics"]["mean"]}
        for task in TASKS
        for record in [json.loads((folder / part_folder(task, STEP) / "part.json").read_bytes())]
    }
    (folder / MANIFEST).write_bytes(seal(values))
    return folder


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


def _root(parts: list[Values]) -> str:
    zeros = "0" * 64
    known = [
        part for part in parts if isinstance(part.get("task"), int) and isinstance(part.get("step"), int)
    ]
    return merkle_root(
        PartEntry.model_construct(task=p["task"], step=p["step"], id=p["id"], sha256=zeros) for p in known
    )


def _first_task(index: Any) -> Callable[[Forge], object]:
    return lambda forge: forge.manifest(lambda values: values["tasks"][0].update(index=index))


def _field(**fields: Any) -> Callable[[Forge], object]:
    return lambda forge: forge.manifest(lambda values: values.update(fields))


def _name(name: str) -> Callable[[Forge], object]:
    return lambda forge: forge.manifest(
        lambda values: (values.update(name=name), values["recipe"]["environment"].update(name=name))
    )


def _array_name(name: str) -> Callable[[Forge], object]:
    """An array of another name, with its files where the file system allows the name."""

    def damage(forge: Forge) -> None:
        forge.record(
            lambda values: values["identity"]["arrays"].update(
                {name: values["identity"]["arrays"]["rewards"]}
            )
        )

    return damage


def _identity(change: Callable[[Values], object]) -> Callable[[Forge], object]:
    return lambda forge: forge.record(lambda values: change(values["identity"]))


def _zarr(array: str = "rewards", **fields: Any) -> Callable[[Forge], object]:
    return lambda forge: forge.zarr(array, **fields)


def _link(name: str) -> Callable[[Forge], object]:
    """A symbolic link to the original file, which is moved outside the dataset."""

    def damage(forge: Forge) -> None:
        path = forge.folder / name
        path.rename(forge.outside / "moved")
        path.symlink_to(forge.outside / "moved")

    return damage


def _special(name: str, make: Callable[[Path], object]) -> Callable[[Forge], object]:
    def damage(forge: Forge) -> None:
        (forge.folder / name).unlink()
        make(forge.folder / name)

    return damage


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's address must be short
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(here)


def _v2(forge: Forge) -> None:
    (forge.part / "rewards" / "zarr.json").unlink()
    (forge.part / "rewards" / ".zarray").write_text('{"zarr_format":2,"dtype":"|O","shape":[120]}')


def _chunk(data: bytes) -> Callable[[Forge], object]:
    return lambda forge: forge.write("rewards/c/0", data)


def _bomb(forge: Forge) -> None:
    """Every array claims 2**26 steps; one array really decodes to that many."""
    forge.rows(2**26)
    forge.write("terminated/c/0", rle_frame(2**26))


def _many_arrays(forge: Forge) -> None:
    """Arrays whose single sizes are below the limit and whose sum is far above it."""
    forge.record(
        lambda values: values["identity"]["arrays"].update(
            {f"extra{i}": values["identity"]["arrays"]["rewards"] for i in range(40)}
        )
    )


def _swap(forge: Forge) -> None:
    left, right = (forge.folder / place / "part.json" for place in (PART, OTHER))
    left_data, right_data = left.read_bytes(), right.read_bytes()
    left.write_bytes(right_data)
    right.write_bytes(left_data)
    forge.manifest(
        lambda values: [
            part.update(id=json.loads(data)["id"], sha256=sha256(data))
            for part, data in zip(values["parts"], (right_data, left_data), strict=True)
        ]
    )


def _nan_array(forge: Forge) -> None:
    """NaN rewards with consistent digests, as if a rollout had returned them."""
    from tcmrl_data.store.arrays import array_digests, encode_arrays, read_arrays

    rewards = read_arrays(forge.part, ["rewards"])["rewards"].copy()
    rewards[7] = np.nan
    forge.write("rewards/c/0", encode_arrays({"rewards": rewards})["rewards/c/0"])
    forge.record(lambda values: values["identity"]["arrays"].update(array_digests({"rewards": rewards})))


def _offsets(values: list[int]) -> Callable[[Forge], object]:
    def damage(forge: Forge) -> None:
        from tcmrl_data.store.arrays import array_digests, encode_arrays

        arrays = {"episode_offsets": np.array(values, dtype=np.int64)}
        forge.write("episode_offsets/c/0", encode_arrays(arrays)["episode_offsets/c/0"])
        forge.record(lambda record: record["identity"]["arrays"].update(array_digests(arrays)))

    return damage


def _manifest_file(data: bytes) -> Callable[[Forge], object]:
    return lambda forge: (forge.folder / MANIFEST).write_bytes(data)


def _repeated_header(forge: Forge) -> None:
    size = (forge.part / "policy.safetensors").stat().st_size
    forge.write("policy.safetensors", struct.pack("<Q", 2**62) + b"{" * (size - 8))


BIG = 2**63 - 1
CODECS = [{"name": "bytes", "configuration": {"endian": "little"}}]
SHARDS = {"name": "sharding_indexed", "configuration": {"chunk_shape": [1], "codecs": CODECS}}

MANIFESTS = [
    Case("empty file", _manifest_file(b""), MANIFEST, "not a manifest"),
    Case("NaN", lambda f: f.text(b'"seed":0', b'"seed":NaN'), MANIFEST, "NaN is not allowed"),
    Case("infinity", lambda f: f.text(b'"seed":0', b'"seed":-Infinity'), MANIFEST, "-Infinity is not"),
    Case("1e999", lambda f: f.text(b'"seed":0', b'"seed":1e999'), MANIFEST, "too large"),
    Case("5000 digits", lambda f: f.text(b'"seed":0', b'"seed":' + b"9" * 5000), MANIFEST, "digits"),
    Case("duplicate key", lambda f: f.text(b'"seed":0', b'"seed":0,"seed":1'), MANIFEST, "key 'seed'"),
    Case(
        "duplicate escaped key",
        lambda f: f.text(b'"seed":0', b'"seed":0,"\\u0073eed":1'),
        MANIFEST,
        "duplicate key 'seed'",
    ),
    Case("no UTF-8", lambda f: f.text(b'"seed":0', b'"seed":"\xff"'), MANIFEST, "utf-8"),
    Case("byte order mark", lambda f: f.text(b"{", b"\xef\xbb\xbf{"), MANIFEST, "not a manifest"),
    Case("surrogate", lambda f: f.text(b'"seed":0', b'"seed":"\\ud800"'), MANIFEST, "seed holds control"),
    Case("extreme depth", _manifest_file(b"[" * 10**5), MANIFEST, "nested deeper"),
    Case("extreme size", _manifest_file(b" " * (20 * 2**20)), MANIFEST, "bytes"),
    Case("too many values", _manifest_file(b"[" + b"[]," * 200_000 + b"[]]"), MANIFEST, "values"),
    Case(
        "many values",
        _manifest_file(b'{"schema_version":1,"x":[' + b"[]," * 60_000 + b"0]}"),
        MANIFEST,
        "digest",
    ),
    Case(
        "40000 bad parts", lambda f: f.text(b'"parts":[', b'"parts":[' + b"{}," * 40_000), MANIFEST, "parts.0"
    ),
    Case(
        "40000 bad tasks", lambda f: f.text(b'"tasks":[', b'"tasks":[' + b"{}," * 40_000), MANIFEST, "tasks.0"
    ),
    Case(
        "1900 bad references",
        lambda f: f.manifest(lambda v: v["references"].update({str(i): {} for i in range(1900)})),
        MANIFEST,
        "references.",
    ),
    Case(
        "recipe of lists",
        lambda f: f.manifest(lambda v: v.update(recipe={"x": [[]] * 60_000})),
        MANIFEST,
        "recipe.",
    ),
    Case("a list", _manifest_file(b"[1]"), MANIFEST, "schema_version"),
    Case("edited", lambda f: f.text(b'"seed":0', b'"seed":1'), MANIFEST, "digest"),
    Case("another version", _field(schema_version=2), MANIFEST, "schema_version 2"),
    Case("a flag as version", _field(schema_version=True), MANIFEST, "schema_version True"),
    Case("a text as version", _field(schema_version="1" * 5000), MANIFEST, "schema_version '1111"),
    Case("unknown key", _field(surprise=1), MANIFEST, "surprise"),
    Case("unknown key with escapes", _field(**{ESCAPE: 1}), MANIFEST, "control characters"),
    Case("a flag as seed", _field(seed=True), MANIFEST, "seed"),
    Case("a float as seed", _field(seed=0.0), MANIFEST, "seed"),
    Case("a text as parts", _field(complete="yes"), MANIFEST, "complete"),
    Case("null tasks", _field(tasks=None), MANIFEST, "tasks"),
    Case("wrong root", lambda f: f.manifest(lambda v: v.update(root="0" * 64), root=False), MANIFEST, "root"),
    Case("name climbs", _name("../../etc"), MANIFEST, "name"),
    Case("name absolute", _name("/etc/passwd\x00"), MANIFEST, "name"),
    Case("name drive", _name("C:\\x"), MANIFEST, "name"),
    Case("name UNC", _name("\\\\server\\share"), MANIFEST, "name"),
    Case("name NUL", _name("point\0robot"), MANIFEST, "name"),
    Case("name newline", _name("point-robot\n"), MANIFEST, "name"),
    Case("name escapes", _name(f"point{ESCAPE}"), MANIFEST, "name"),
    Case("name 5000", _name("a" * 5000), MANIFEST, "name"),
    Case("name case", _name("Point-Robot"), MANIFEST, "name"),
    Case("name lookalike", _name("pοint-rοbοt"), MANIFEST, "name"),
    Case("name unknown", _name("no-such-environment"), MANIFEST, "no-such-environment", "verify"),
    Case(
        "other environment",
        lambda f: f.manifest(lambda v: v["recipe"]["environment"].update(name="point-robot-wind")),
        MANIFEST,
        "recipe.environment.name",
    ),
    Case("task -1", _first_task(-1), MANIFEST, "tasks.0.index"),
    Case("task 2**70", _first_task(2**70), MANIFEST, "tasks.0.index"),
    Case("task as path", _first_task("../7"), MANIFEST, "tasks.0.index"),
    Case("task as float", _first_task(0.0), MANIFEST, "tasks.0.index"),
    Case(
        "task twice", lambda f: f.manifest(lambda v: v["tasks"].append(v["tasks"][0])), MANIFEST, "each once"
    ),
    Case(
        "part twice", lambda f: f.manifest(lambda v: v["parts"].append(v["parts"][1])), MANIFEST, "each once"
    ),
    Case("part missing", lambda f: f.manifest(lambda v: v["parts"].pop()), MANIFEST, "complete"),
    Case(
        "part of no task",
        lambda f: f.manifest(lambda v: v["parts"][1].update(task=99)),
        MANIFEST,
        "parts names a task",
    ),
    Case(
        "step 4000 digits",
        lambda f: f.manifest(lambda v: v["parts"][0].update(step=10**3999)),
        MANIFEST,
        "step",
    ),
    Case(
        "id newline", lambda f: f.manifest(lambda v: v["parts"][0].update(id="a" * 64 + "\n")), MANIFEST, "id"
    ),
    Case(
        "id climbs",
        lambda f: f.manifest(lambda v: v["parts"][0].update(id="../" * 20)),
        MANIFEST,
        "parts.0.id",
    ),
    Case(
        "oracle text",
        lambda f: f.manifest(lambda v: v["references"]["0"].update(oracle="high")),
        MANIFEST,
        "references.0.oracle",
    ),
    Case(
        "references",
        lambda f: f.manifest(lambda v: v["references"]["0"].update(oracle=1e9)),
        MANIFEST,
        "references",
        "verify",
    ),
    Case(
        "no source", lambda f: f.manifest(lambda v: v["recipe"]["behavior"].pop("source")), MANIFEST, "source"
    ),
    Case(
        "description escapes",
        lambda f: f.manifest(lambda v: v["recipe"]["about"].update(description=f"x{ESCAPE}")),
        MANIFEST,
        "recipe.about.description",
    ),
    Case(
        "parameter escapes",
        lambda f: f.manifest(lambda v: v["tasks"][0]["parameters"].update({"\x9b2J": 1})),
        MANIFEST,
        "tasks.0.parameters",
    ),
    Case(
        "parameter turns text",
        lambda f: f.manifest(lambda v: v["tasks"][0]["parameters"].update(goal="\u202ekcatta")),
        MANIFEST,
        "tasks.0.parameters.goal",
    ),
    Case(
        "parameters edited",
        lambda f: f.manifest(lambda v: v["tasks"][0]["parameters"].update(goal=[0.0, 2.0])),
        MANIFEST,
        "parameters of task 0",
        "verify",
    ),
    Case(
        "split edited",
        lambda f: f.manifest(lambda v: v["tasks"][1].update(split="train")),
        MANIFEST,
        "split of task 3",
        "verify",
    ),
    Case(
        "trillion tasks",
        lambda f: f.manifest(lambda v: v["recipe"]["environment"].update(tasks=10**12)),
        MANIFEST,
        "recipe.environment.tasks",
        "verify",
    ),
    Case(
        "billion lanes",
        lambda f: f.manifest(lambda v: v["recipe"]["rollouts"].update(lanes=10**9, episodes=10**9)),
        "part.json",
        "identity.settings",
        "verify",
    ),
    Case(
        "unknown setting",
        lambda f: f.manifest(lambda v: v["recipe"]["environment"].update(plugin="evil.py")),
        MANIFEST,
        "recipe.environment",
        "verify",
    ),
]

RECORDS = [
    Case(
        "20000 bad files",
        lambda f: f.record(lambda v: v["files"].update({str(i): {} for i in range(20_000)})),
        "part.json",
        "files.",
    ),
    Case("array climbs", _array_name("../../../../../outside/secret"), "part.json", "no array name"),
    Case("array absolute", _array_name("/etc"), "part.json", "no array name"),
    Case("array case", _array_name("Rewards"), "part.json", "no array name"),
    Case("array lookalike", _array_name("rеwards"), "part.json", "no array name"),
    Case("array newline", _array_name("rewards\n"), "part.json", "control characters"),
    Case("array NUL", _array_name("rewards\0"), "part.json", "control characters"),
    Case("array 5000", _array_name("a" * 5000), "part.json", "no array name"),
    Case("array drive", _array_name("c:\\x"), "part.json", "no array name"),
    Case("array without files", _array_name("success"), "success/zarr.json", "missing"),
    Case("40 arrays", _many_arrays, "part.json", "identity.arrays"),
    Case(
        "file climbs",
        lambda f: f.record(lambda v: v["files"].update({"../../secret": v["files"]["zarr.json"]})),
        "part.json",
        "files names",
    ),
    Case(
        "file climbs inside",
        lambda f: f.record(lambda v: v["files"].update({"rewards/../../x": v["files"]["zarr.json"]})),
        "part.json",
        "files names",
    ),
    Case(
        "chunk unrecorded",
        lambda f: f.record(lambda v: v["files"].pop("rewards/c/0")),
        "part.json",
        "rewards/c/0",
    ),
    Case(
        "policy unrecorded",
        lambda f: f.record(lambda v: v["files"].pop("policy.json")),
        "part.json",
        "policy.json",
    ),
    Case(
        "object array",
        _identity(lambda v: v["arrays"]["rewards"].update(dtype="object")),
        "part.json",
        "dtype",
    ),
    Case(
        "float offsets",
        _identity(lambda v: v["arrays"]["episode_offsets"].update(dtype="float32")),
        "part.json",
        "episode_offsets",
    ),
    Case(
        "negative shape",
        _identity(lambda v: v["arrays"]["actions"].update(shape=[-120, 2])),
        "part.json",
        "shape",
    ),
    Case(
        "huge shape", _identity(lambda v: v["arrays"]["rewards"].update(shape=[2**80])), "part.json", "shape"
    ),
    Case(
        "no episodes",
        _identity(lambda v: v["arrays"]["episode_offsets"].update(shape=[1])),
        "part.json",
        "shape",
    ),
    Case("no rewards", _identity(lambda v: v["arrays"].pop("rewards")), "part.json", "rewards is missing"),
    Case(
        "mean 1e999",
        lambda f: f.record(lambda v: None, text=lambda t: t.replace('"mean":', '"mean":1e999,"x":')),
        "part.json",
        "too large",
    ),
    Case(
        "mean edited",
        lambda f: f.record(lambda v: v["statistics"].update(mean=1e6)),
        "part.json",
        "statistics.mean",
        "verify",
    ),
    Case(
        "record of 2 MB",
        lambda f: f.record(lambda v: v["provenance"].update(host="x" * 2**21)),
        "part.json",
        "bytes",
    ),
    Case(
        "host escapes",
        lambda f: f.record(lambda v: v["provenance"].update(host=ESCAPE)),
        "part.json",
        "provenance.host",
    ),
    Case("another seed", _identity(lambda v: v.update(seed=9)), "part.json", "identity.seed", "verify"),
    Case("another task", _identity(lambda v: v.update(task=7)), "part.json", "identity.task"),
    Case("parts swapped", _swap, "part.json", "identity.task"),
]

LAYOUTS = [
    Case("Zarr v2", _zarr(zarr_format=2), "rewards/zarr.json", "zarr_format"),
    Case("Zarr v2 files", _v2, "rewards/zarr.json", "missing"),
    Case("group as array", _zarr(node_type="group"), "rewards/zarr.json", "node_type"),
    Case("object dtype", _zarr(data_type="|O"), "rewards/zarr.json", "data_type"),
    Case("string dtype", _zarr(data_type="string"), "rewards/zarr.json", "data_type"),
    Case("bytes dtype", _zarr(data_type="variable_length_bytes"), "rewards/zarr.json", "data_type"),
    Case("structured dtype", _zarr(data_type={"name": "structured"}), "rewards/zarr.json", "data_type"),
    Case("unknown codec", _zarr(codecs=[*CODECS, {"name": "evil"}]), "rewards/zarr.json", "codecs"),
    Case("pickle codec", _zarr(codecs=[{"name": "numcodecs.pickle"}]), "rewards/zarr.json", "codecs"),
    Case("sharding", _zarr(codecs=[SHARDS]), "rewards/zarr.json", "codecs"),
    Case("storage transformer", _zarr(storage_transformers=[{"name": "x"}]), "rewards/zarr.json", "storage"),
    Case("negative rows", _zarr(shape=[-1]), "rewards/zarr.json", "shape"),
    Case("overflowing rows", _zarr(shape=[BIG]), "rewards/zarr.json", "shape"),
    Case("rows beyond int64", _zarr(shape=[2**70]), "rewards/zarr.json", "shape"),
    Case("ten axes", _zarr(shape=[1] * 10), "rewards/zarr.json", "shape"),
    Case("rows as float", _zarr(shape=[120.0]), "rewards/zarr.json", "shape"),
    Case("petabytes", lambda f: f.rows(2**39), PART, "shape asks for"),
    Case(
        "huge chunks",
        _zarr(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**39]}}),
        "rewards/zarr.json",
        "chunk_grid",
    ),
    Case(
        "empty chunks",
        _zarr(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [0]}}),
        "rewards/zarr.json",
        "chunk_shape",
    ),
    Case("chunk names", _zarr(chunk_key_encoding={"name": "v2"}), "rewards/zarr.json", "chunk_key_encoding"),
    Case("attributes", _zarr(attributes={ESCAPE: 1}), "rewards/zarr.json", "attributes"),
    Case("fill value", _zarr(fill_value="0x7fc00000"), "rewards/zarr.json", "fill_value"),
    Case("axes of another array", _zarr(dimension_names=["episode"]), "rewards/zarr.json", "dimension_names"),
    Case("unknown field", _zarr(must_understand=True), "rewards/zarr.json", "must_understand"),
    Case(
        "metadata NaN", lambda f: f.write("rewards/zarr.json", b'{"shape":NaN}'), "rewards/zarr.json", "NaN"
    ),
    Case(
        "metadata deep", lambda f: f.write("rewards/zarr.json", b"[" * 10**4), "rewards/zarr.json", "nested"
    ),
    Case("metadata big", lambda f: f.write("rewards/zarr.json", b" " * 10**6), "rewards/zarr.json", "bytes"),
    Case(
        "group attributes",
        lambda f: f.write("zarr.json", b'{"zarr_format":3,"node_type":"group","attributes":{"x":1}}'),
        f"{PART}/zarr.json",
        "attributes",
    ),
]

CHUNKS = [
    Case(
        "bomb beyond the chunk", _chunk(rle_frame(2**24, declared=2**24)), "rewards/c/0", "declares", "read"
    ),
    Case("bomb declared small", _chunk(rle_frame(2**24, declared=480)), "rewards", "does not decode", "read"),
    Case("frame of 2**63", _chunk(rle_frame(2**17, declared=2**63)), "rewards/c/0", "declares", "read"),
    Case(
        "frame without size",
        _chunk(with_checksum(b"\x28\xb5\x2f\xfd\x00\x58" + b"\x03\x00\x00\x00")),
        "rewards/c/0",
        "zstd frame",
        "read",
    ),
    Case(
        "two frames",
        lambda f: f.write("rewards/c/0", with_checksum(2 * rle_frame(480)[:-4])),
        "rewards",
        "does not decode",
        "read",
    ),
    Case("justified by nothing", _bomb, PART, "shape asks for"),
    Case(
        "a pickle as chunk",
        lambda f: f.write("rewards/c/0", f.payload()),
        "rewards/c/0",
        "zstd frame",
        "read",
    ),
    Case("empty chunk", _chunk(b""), "rewards/c/0", "zstd frame", "read"),
    Case("wrong checksum", _chunk(rle_frame(480)[:-4] + b"\0\0\0\0"), "rewards", "does not decode", "read"),
    Case("other values", _chunk(rle_frame(480)), "rewards", "sha256", "verify"),
    Case("NaN rewards", _nan_array, "rewards", "not finite", "verify"),
    Case("offsets fall", _offsets([0, 20, 40, 30, 80, 100, 120]), "step_0000150", "episode_offsets", "read"),
    Case(
        "offsets wrap",
        _offsets([0, BIG, -BIG - 1, -1, 80, 100, 120]),
        "step_0000150",
        "episode_offsets",
        "read",
    ),
    Case("offsets short", _offsets([0, 20, 40, 60, 80, 100, 119]), "step_0000150", "episode_offsets", "read"),
    Case(
        "episodes moved",
        _offsets([0, 20, 40, 60, 80, 101, 120]),
        "step_0000150/terminated",
        "last step",
        "verify",
    ),
]

POLICIES = [
    Case(
        "pickle as weights",
        lambda f: f.write("policy.safetensors", f.payload()),
        "policy.safetensors",
        "bytes",
        "read",
    ),
    Case(
        "pickle as policy",
        lambda f: f.write("policy.json", f.payload()),
        "policy.json",
        "not a policy",
        "read",
    ),
    Case(
        "SB3 zip",
        lambda f: f.write("policy.safetensors", SB3_ZIP),
        "policy.safetensors",
        "safetensors",
        "read",
    ),
    Case(
        "overlapping",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=h["log_std.bias"]["data_offsets"])),
        "policy.safetensors",
        "safetensors",
        "read",
    ),
    Case(
        "huge offsets",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=[0, 2**60])),
        "policy.safetensors",
        "safetensors",
        "read",
    ),
    Case(
        "negative offsets",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=[-8, 0])),
        "policy.safetensors",
        "safetensors",
        "read",
    ),
    Case(
        "huge tensor",
        lambda f: f.header(lambda h: h["mean.bias"].update(shape=[2**62])),
        "policy.safetensors",
        "safetensors",
        "read",
    ),
    Case("header of 2**62", _repeated_header, "policy.safetensors", "safetensors", "read"),
    Case(
        "unknown dtype",
        lambda f: f.header(lambda h: h["mean.bias"].update(dtype="F8_E4M3")),
        "policy.safetensors",
        "safetensors",
        "read",
    ),
    Case(
        "NaN weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.nan)),
        "policy.safetensors",
        "mean.bias",
        "read",
    ),
    Case(
        "infinite weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.inf)),
        "policy.safetensors",
        "mean.bias",
        "read",
    ),
    Case(
        "wrong shapes",
        lambda f: f.weights(lambda t: t.update({"mean.bias": np.zeros((1, 2), np.float32)})),
        "policy.safetensors",
        "shapes",
        "read",
    ),
    Case(
        "whole numbers",
        lambda f: f.weights(lambda t: t.update({"mean.bias": np.zeros(2, np.int32)})),
        "policy.safetensors",
        "mean.bias",
        "read",
    ),
    Case(
        "tensor escapes",
        lambda f: f.weights(lambda t: t.update({ESCAPE: t["mean.bias"]})),
        "policy.safetensors",
        "names",
        "read",
    ),
    Case(
        "tensor missing",
        lambda f: f.weights(lambda t: t.pop("mean.bias")),
        "policy.safetensors",
        "shapes",
        "read",
    ),
    Case(
        "other weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(0.5)),
        "policy.json",
        "digest",
        "verify",
    ),
    Case("terabyte layers", lambda f: f.policy(hidden=[65536] * 16), "policy.safetensors", "bytes", "read"),
    Case("layer of 10**9", lambda f: f.policy(hidden=[10**9]), "policy.json", "hidden", "read"),
    Case("thousand layers", lambda f: f.policy(hidden=[1] * 1000), "policy.json", "hidden", "read"),
    Case("kind pickle", lambda f: f.policy(kind="pickle"), "policy.json", "kind", "read"),
    Case(
        "noise 1e999",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":1e999}'),
        "policy.json",
        "too large",
        "read",
    ),
    Case("policy deep", lambda f: f.write("policy.json", b"[" * 10**4), "policy.json", "nested", "read"),
    Case("policy big", lambda f: f.write("policy.json", b" " * 10**6), "policy.json", "bytes", "read"),
    Case(
        "scripted with weights",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":0.1}'),
        "policy.json",
        "digest",
        "verify",
    ),
]
SB3_ZIP = b"PK\x03\x04" + bytes(26) + b"data" + bytes(4096)

FILES = [
    Case("chunk linked", _link(f"{PART}/rewards/c/0"), "rewards/c/0", "a link"),
    Case(
        "chunk linked to a device",
        _special(f"{PART}/rewards/c/0", lambda p: p.symlink_to("/dev/zero")),
        "rewards/c/0",
        "a link",
    ),
    Case(
        "chunk linked to nothing",
        _special(f"{PART}/rewards/c/0", lambda p: p.symlink_to("/nothing")),
        "rewards/c/0",
        "a link",
    ),
    Case(
        "chunk linked to itself",
        _special(f"{PART}/rewards/c/0", lambda p: p.symlink_to("0")),
        "rewards/c/0",
        "a link",
    ),
    Case("metadata linked", _link(f"{PART}/rewards/zarr.json"), "rewards/zarr.json", "a link"),
    Case("policy linked", _link(f"{PART}/policy.json"), "policy.json", "a link"),
    Case("record linked", _link(f"{PART}/part.json"), "part.json", "a link"),
    Case("manifest linked", _link(MANIFEST), MANIFEST, "a link"),
    Case("array linked", _link(f"{PART}/rewards"), "rewards", "a link"),
    Case("part linked", _link(PART), PART, "a link"),
    Case("snapshots linked", _link("tasks/00000/snapshots"), "tasks/00000/snapshots", "a link"),
    Case("task linked", _link("tasks/00000"), "tasks/00000", "a link"),
    Case("tasks linked", _link("tasks"), "tasks", "a link"),
    Case(
        "chunk of two names",
        lambda f: os.link(f.part / "rewards/c/0", f.outside / "same"),
        "rewards/c/0",
        "hard links",
    ),
    Case(
        "manifest of two names",
        lambda f: os.link(f.folder / MANIFEST, f.outside / "same"),
        MANIFEST,
        "hard links",
    ),
    Case("chunk a FIFO", _special(f"{PART}/rewards/c/0", os.mkfifo), "rewards/c/0", "a FIFO"),
    Case("metadata a FIFO", _special(f"{PART}/rewards/zarr.json", os.mkfifo), "rewards/zarr.json", "a FIFO"),
    Case("record a FIFO", _special(f"{PART}/part.json", os.mkfifo), "part.json", "a FIFO"),
    Case("policy a FIFO", _special(f"{PART}/policy.json", os.mkfifo), "policy.json", "a FIFO"),
    Case("manifest a FIFO", _special(MANIFEST, os.mkfifo), MANIFEST, "a FIFO"),
    Case("chunk a socket", _special(f"{PART}/rewards/c/0", _socket), "rewards/c/0", "a socket"),
    Case("chunk a folder", _special(f"{PART}/rewards/c/0", Path.mkdir), "rewards/c/0", "a folder"),
    Case("chunk missing", lambda f: f.rename("rewards/c/0"), "rewards/c/0", "missing"),
    Case("weights missing", lambda f: f.rename("policy.safetensors"), "policy.safetensors", "missing"),
    Case(
        "file of odd name", lambda f: (f.folder / "tasks" / f"a{ESCAPE}").touch(), ESCAPE, "no part", "verify"
    ),
    Case(
        "file of broken name",
        lambda f: Path(os.fsdecode(bytes(f.folder) + b"/\xff\xfe")).touch(),
        "\udcff\udcfe",
        "no part",
        "verify",
    ),
    Case(
        "code beside data",
        lambda f: (f.part / "sitecustomize.py").write_text("import os"),
        "sitecustomize.py",
        "no part",
        "verify",
    ),
    Case(
        "pickle beside data",
        lambda f: (f.part / "policy.pkl").write_bytes(f.payload()),
        "policy.pkl",
        "no part",
        "verify",
    ),
    Case(
        "lock linked",
        lambda f: (f.folder / ".lock").symlink_to(f.outside / "secret"),
        ".lock",
        "a link",
        "verify",
    ),
]

CASES = [*MANIFESTS, *RECORDS, *LAYOUTS, *CHUNKS, *POLICIES, *FILES]
