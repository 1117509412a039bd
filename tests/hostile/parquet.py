"""Forged Parquet files for `tcmrl-data import`, each with one attack.

The footer of a sound file is decoded, changed and written again by the few lines of Thrift's compact protocol
below; page headers are changed in place.
"""

import io
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.interchange.readers.thrift import CompactReader
from tests.hostile.source import Make, Places

Record = dict[int, Any]

BINARY, LIST, STRUCT = 8, 9, 12
"""Numbers of Thrift's types."""


class Number(int):
    """An integer with Thrift's number of its type."""

    kind = 5


class Decoder(CompactReader):
    """Keeps the types of integers."""

    def _value(self, kind: int, depth: int) -> Any:
        value = super()._value(kind, depth)
        if isinstance(value, bool) or not isinstance(value, int):
            return value
        made = Number(value)
        made.kind = kind
        return made


def number(value: int) -> bytes:
    """An unsigned number of any length."""
    made = b""
    while value > 127:
        made, value = made + bytes([value & 127 | 128]), value >> 7
    return made + bytes([value])


def signed(value: int) -> bytes:
    return number(value << 1 if value >= 0 else (-value << 1) - 1)


def encoded(value: Any) -> tuple[int, bytes]:
    """The type of a value, and its bytes."""
    if isinstance(value, int):
        return getattr(value, "kind", Number.kind), signed(value)
    if isinstance(value, bytes):
        return BINARY, number(len(value)) + value
    if isinstance(value, list):
        items = [encoded(item) for item in value]
        kind = items[0][0] if items else STRUCT
        head = bytes([min(len(items), 15) << 4 | kind]) + (number(len(items)) if len(items) > 14 else b"")
        return LIST, head + b"".join(content for _, content in items)
    return STRUCT, record(value)


def record(fields: Record) -> bytes:
    made = b""
    for place, value in fields.items():
        if isinstance(value, bool):
            made += bytes([1 if value else 2]) + signed(place)
        else:
            kind, content = encoded(value)
            made += bytes([kind]) + signed(place) + content
    return made + b"\0"


def replaced(fields: Record, place: int, value: int) -> None:
    """Replaces an integer by one of the same type."""
    made = Number(value)
    made.kind = fields[place].kind
    fields[place] = made


def columns(rows: int = 6) -> dict[str, Any]:
    """Two episodes of equal length."""
    half = np.arange(rows) < rows // 2
    last = np.arange(rows) % (rows // 2) == rows // 2 - 1
    observation = np.where(half, 0.0, 1.0).astype(np.float32)[:, None] * np.ones((1, 2), np.float32)
    return {
        "episode": np.where(half, 0, 1),
        "observation": list(observation),
        "action": list(np.zeros((rows, 1), np.float32)),
        "reward": np.zeros(rows, np.float32),
        "next_observation": list(observation),
        "terminated": np.zeros(rows, bool),
        "truncated": last,
    }


def written(made: Mapping[str, Any], metadata: Mapping[str, str] | None = None, **options: Any) -> bytes:
    """A sound file."""
    import pyarrow
    from pyarrow import parquet

    table = pyarrow.table(dict(made))
    target = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata(metadata), target, **options)
    return target.getvalue()


def parts(content: bytes) -> tuple[bytes, bytes]:
    """A file's data and its footer."""
    length = int.from_bytes(content[-8:-4], "little")
    return content[: -8 - length], content[-8 - length : -8]


def closed(data: bytes, footer: bytes) -> bytes:
    return data + footer + len(footer).to_bytes(4, "little") + b"PAR1"


def file(make: Callable[[], bytes]) -> Make:
    def case(places: Places) -> Path:
        places.folder.mkdir()
        path = places.folder / "forged.parquet"
        path.write_bytes(make())
        return path

    return case


def footer(change: Callable[[Record], object]) -> Make:
    """A sound file whose footer is changed."""

    def make() -> bytes:
        data, found = parts(written(columns()))
        fields = Decoder(found).record()
        change(fields)
        return closed(data, record(fields))

    return file(make)


def chunk(name: str, change: Callable[[Record], object]) -> Make:
    """A sound file in which what the footer says of a column's chunk is changed."""
    return footer(lambda fields: change(chunk_of(fields, name)))


def chunk_of(fields: Record, name: str) -> Record:
    found: Record = next(one for one in fields[4][0][1] if one[3][3][0] == name.encode())
    return found


def page(change: Callable[[Record], object], name: str = "reward", **options: Any) -> Make:
    """A sound file whose last column's page has another header; it is put at the end of the data."""

    def make() -> bytes:
        data, found = parts(written(columns(), use_dictionary=False, **options))
        fields = Decoder(found).record()
        meta = chunk_of(fields, name)[3]
        reader = Decoder(data[meta[9] : meta[9] + meta[7]])
        header = reader.record()
        content = data[meta[9] + reader.position : meta[9] + meta[7]]
        change(header)
        moved = record(header) + content
        replaced(meta, 9, len(data))
        replaced(meta, 7, len(moved))
        return closed(data + moved, record(fields))

    return file(make)


def about(**changes: Any) -> Make:
    """A file whose metadata are changed."""
    attributes = {"format_version": 1, "task": 0, "split": "train", "parameters": "{}", **changes}
    return file(lambda: written(columns(), {"tcmrl": json.dumps(attributes)}))


def lists_of(width: int) -> bytes:
    """A file whose own schema of Arrow says lists of another length than the file has."""
    import pyarrow
    from pyarrow import parquet

    content, empty = written(columns()), io.BytesIO()
    found = parquet.read_schema(io.BytesIO(content))
    kinds = {one.name: one.type for one in found}
    kinds["observation"] = pyarrow.list_(found.field("observation").type.value_field, width)
    parquet.write_table(pyarrow.table({name: pyarrow.array([], kind) for name, kind in kinds.items()}), empty)
    data, footer_ = parts(content)
    fields = Decoder(footer_).record()
    fields[5] = Decoder(parts(empty.getvalue())[1]).record()[5]
    return closed(data, record(fields))


def many(name: str, rows: int = 4_000_000) -> bytes:
    """A file of a few kilobytes whose column has millions of equal values."""
    made = {"episode": np.zeros(rows, np.int8), "reward": np.zeros(rows, np.float32)}
    made["truncated"] = np.zeros(rows, bool)
    made |= {"terminated": made["truncated"]}
    for other in ("observation", "action", "next_observation"):
        made[other] = np.zeros(rows, np.float32)
    return written({name: made[name]} | made, compression="zstd")


DEEP = b"\x1c" * 100_000
PARQUET: dict[str, Make] = {
    "parquet: an empty file": file(lambda: b""),
    "parquet: magic alone": file(lambda: b"PAR1PAR1"),
    "parquet: cut": file(lambda: written(columns())[:-9]),
    "parquet: a footer longer than the file": file(lambda: b"PAR1" + b"\xff\xff\xff\x7fPAR1"),
    "parquet: a footer of brackets": file(lambda: closed(b"PAR1", DEEP)),
    "parquet: a footer of lists": file(lambda: closed(b"PAR1", b"\x19" + b"\x19" * 100_000)),
    "parquet: a list of 2^60": file(lambda: closed(b"PAR1", b"\x19\xfc" + number(2**60))),
    "parquet: text of 2^60": file(lambda: closed(b"PAR1", b"\x18" + number(2**60))),
    "parquet: a number without end": file(lambda: closed(b"PAR1", b"\x15" + b"\xff" * 100)),
    "parquet: a million truths": file(lambda: closed(b"PAR1", b"\x11" * 10**6)),
    "parquet: no schema": footer(lambda fields: fields.update({2: []})),
    "parquet: a thousand columns": footer(lambda fields: fields.update({2: fields[2] * 100})),
    "parquet: a schema that ends": footer(lambda fields: replaced(fields[2][0], 5, 99)),
    "parquet: rows that are not there": footer(lambda fields: replaced(fields, 3, 2**40)),
    "parquet: a row group of 2^40": footer(
        lambda fields: [replaced(fields, 3, 2**40), replaced(fields[4][0], 3, 2**40)]
    ),
    "parquet: rows less than none": footer(
        lambda fields: [replaced(fields, 3, -6), replaced(fields[4][0], 3, -6)]
    ),
    "parquet: another file's column": chunk("reward", lambda one: one.update({1: b"/etc/passwd"})),
    "parquet: an encrypted column": chunk("reward", lambda one: one.update({8: {1: {}}})),
    "parquet: values of 2^40": chunk("reward", lambda one: replaced(one[3], 5, 2**40)),
    "parquet: values less than none": chunk("reward", lambda one: replaced(one[3], 5, -1)),
    "parquet: more values than pages": chunk("reward", lambda one: replaced(one[3], 5, 12)),
    "parquet: a chunk behind the end": chunk(
        "reward", lambda one: [replaced(one[3], place, 2**40) for place in (9, 11)]
    ),
    "parquet: a chunk before the file": chunk("reward", lambda one: replaced(one[3], 9, -4)),
    "parquet: a chunk of 2^40 bytes": chunk("reward", lambda one: replaced(one[3], 7, 2**40)),
    "parquet: a codec of tomorrow": chunk("reward", lambda one: replaced(one[3], 4, 77)),
    "parquet: another type": chunk("reward", lambda one: replaced(one[3], 1, 6)),
    "parquet: a page of 2 GiB": page(lambda header: replaced(header, 2, 2**31 - 1)),
    "parquet: a page less than none": page(lambda header: replaced(header, 3, -1)),
    "parquet: a page of other values": page(lambda header: replaced(header[5], 1, 2**30)),
    "parquet: a page of two sizes": page(lambda header: replaced(header, 2, 9), compression="none"),
    "parquet: a page of another encoding": page(lambda header: replaced(header[5], 2, 5)),
    "parquet: a page of unknown kind": page(lambda header: replaced(header, 1, 9)),
    "parquet: a page that unpacks to less": page(lambda header: replaced(header, 2, 3), compression="zstd"),
    "parquet: a bomb of numbers": file(lambda: many("reward")),
    "parquet: a bomb of truths": file(lambda: many("truncated", 40_000_000 // 4)),
    "parquet: lists of 2^30 by Arrow's word": file(lambda: lists_of(2**30)),
    "parquet: metadata in brackets": file(lambda: written(columns(), {"tcmrl": "[" * 100_000})),
    "parquet: metadata without a task": file(lambda: written(columns(), {"tcmrl": "{}"})),
    "parquet: another version": about(format_version=2),
    "parquet: a task less than none": about(task=-1),
    "parquet: parameters that obey no one": about(parameters='{"a": "\\u001b[2J"}'),
    "parquet: a column of escapes": file(lambda: written({"\x1b[2J": np.zeros(2), "episode": [["a"]] * 2})),
}


def fifo(places: Places) -> Path:
    places.folder.mkdir()
    os.mkfifo(places.folder / "f.parquet")
    return places.folder / "f.parquet"


PARQUET["parquet: a FIFO"] = fifo
