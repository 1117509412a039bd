"""Forged Parquet files for `tcmrl-data import`, each with one attack."""

import io
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile.source import Make, Places


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


def closed(data: bytes, footer: bytes) -> bytes:
    return data + footer + len(footer).to_bytes(4, "little") + b"PAR1"


def file(make: Callable[[], bytes]) -> Make:
    def case(places: Places) -> Path:
        places.folder.mkdir()
        path = places.folder / "forged.parquet"
        path.write_bytes(make())
        return path

    return case


def elsewhere() -> bytes:
    """A sound file whose footer says that all columns lie in another file."""
    from pyarrow import parquet

    content, footer = written(columns()), io.BytesIO()
    metadata = parquet.ParquetFile(io.BytesIO(content)).metadata
    metadata.set_file_path("/etc/passwd")
    metadata.write_metadata_file(footer)
    length = int.from_bytes(content[-8:-4], "little")
    return content[: -8 - length] + footer.getvalue()[4:]


def about(**changes: Any) -> Make:
    """A file whose metadata are changed."""
    attributes = {"format_version": 1, "task": 0, "split": "train", "parameters": "{}", **changes}
    return file(lambda: written(columns(), {"tcmrl": json.dumps(attributes)}))


def many(name: str, rows: int = 4_000_000) -> bytes:
    """A file of a few kilobytes whose column has millions of equal values."""
    made = {"episode": np.zeros(rows, np.int8), "reward": np.zeros(rows, np.float32)}
    made["truncated"] = np.zeros(rows, bool)
    made |= {"terminated": made["truncated"]}
    for other in ("observation", "action", "next_observation"):
        made[other] = np.zeros(rows, np.float32)
    return written({name: made[name]} | made, compression="zstd")


PARQUET: dict[str, Make] = {
    "parquet: cut": file(lambda: written(columns())[:-9]),
    "parquet: a list of 2^60": file(lambda: closed(b"PAR1", b"\x19\xfc" + b"\x80" * 8 + b"\x10")),
    "parquet: a bomb of numbers": file(lambda: many("reward")),
    "parquet: columns in another file": file(elsewhere),
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
