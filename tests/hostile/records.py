"""Forged records of parts, and forged archives."""

from collections.abc import Callable
from typing import Any

from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry
from tests.hostile import archives
from tests.hostile.case import ESCAPE, Case, Damage, in_part
from tests.hostile.datasets import OTHER, PART, Forge, Values


def _array_name(name: str) -> Damage:
    """A further array of this name in the record."""
    return _identity(lambda values: values["arrays"].update({name: values["arrays"]["rewards"]}))


def _identity(change: Callable[[Values], object]) -> Damage:
    return lambda forge: forge.record(lambda values: change(values["identity"]))


def _many_arrays(forge: Forge) -> None:
    forge.record(
        lambda values: values["identity"]["arrays"].update(
            {f"extra{i}": values["identity"]["arrays"]["rewards"] for i in range(40)}
        )
    )


def _swap(forge: Forge) -> None:
    """Two parts at each other's places, of which the table tells the truth."""
    files = [forge.folder / PART, forge.folder / OTHER]
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, reversed(contents), strict=True):
        file.write_bytes(content)

    def change(rows: list[Any]) -> None:
        for column in ("id", "sha256", "size"):
            place = PartEntry._fields.index(column)
            rows[1][place], rows[2][place] = rows[2][place], rows[1][place]

    forge.rows(PARTS_TABLE, change)


RECORDS = [
    in_part(
        "20000 bad arrays",
        _identity(lambda v: v["arrays"].update({str(i): {} for i in range(20_000)})),
        "part.json",
        "arrays",
    ),
    in_part("array climbs", _array_name("../../../../../outside/secret"), "part.json", "no array name"),
    in_part("array newline", _array_name("rewards\n"), "part.json", "control characters"),
    in_part("array without files", _array_name("success"), "arrays/success/zarr.json", "missing"),
    in_part("40 arrays", _many_arrays, "part.json", "identity.arrays"),
    in_part("record missing", lambda f: f.take("part.json"), "part.json", "missing"),
    in_part("record a list", lambda f: f.write("part.json", b"[]"), "part.json", "schema_version"),
    in_part("record deep", lambda f: f.write("part.json", b"[" * 10**5), "part.json", "nested"),
    in_part(
        "record of an earlier version",
        lambda f: f.record(lambda v: v.update(schema_version=1)),
        "part.json",
        "schema_version 1",
    ),
    in_part(
        "id of another",
        lambda f: f.record(lambda v: None, text=lambda t: t.replace('"step":150', '"step":151')),
        "part.json",
        "id",
    ),
    in_part("member unrecorded", lambda f: f.write("rewards/c/1", b""), "arrays/rewards/c/1", "agree"),
    in_part("chunk missing", lambda f: f.take("rewards/c/0"), "arrays/rewards/c/0", "agree"),
    in_part("policy missing", lambda f: f.take("policy.json"), "policy.json", "agree"),
    in_part("weights missing", lambda f: f.take("policy.safetensors"), "policy.safetensors", "missing"),
    in_part("pickle beside data", lambda f: f.write("policy.pkl", f.payload()), "policy.pkl", "agree"),
    in_part(
        "object array",
        _identity(lambda v: v["arrays"]["rewards"].update(dtype="object")),
        "part.json",
        "dtype",
    ),
    in_part(
        "negative shape",
        _identity(lambda v: v["arrays"]["actions"].update(shape=[-120, 2])),
        "part.json",
        "shape",
    ),
    in_part(
        "no episodes",
        _identity(lambda v: v["arrays"]["episode_offsets"].update(shape=[1])),
        "part.json",
        "shape",
    ),
    in_part("no rewards", _identity(lambda v: v["arrays"].pop("rewards")), "part.json", "rewards is missing"),
    in_part(
        "mean edited",
        lambda f: f.record(lambda v: v["statistics"].update(mean=1e6)),
        "part.json",
        "statistics.mean",
        "verify",
    ),
    in_part(
        "record of 2 MB",
        lambda f: f.record(lambda v: v["behavior"].update(x="x" * 2**21)),
        "part.json",
        "bytes",
    ),
    in_part(
        "host escapes",
        lambda f: f.record(lambda v: v["platform"].update(cpu=ESCAPE)),
        "part.json",
        "platform.cpu",
    ),
    in_part("another seed", _identity(lambda v: v.update(seed=9)), "", "identity.seed", "verify"),
    in_part("another task", _identity(lambda v: v.update(task=7)), "", "the manifest"),
    in_part("parts swapped", _swap, "", "the manifest"),
]

ARCHIVES = [
    Case(f"archive: {name}", lambda forge, data=data: forge.archive(data), PART, (), "read")
    for name, data in archives.FORGED.items()
]
