"""Parquet, one file per task, `train/task_00000.parquet` and so on: one row a transition.

| column | type | holds |
|---|---|---|
| task, step | int32 | index of the task, and the snapshot's training step |
| split | text | of the task: `train` or `test` |
| parameter_goal … | float64, a list of them, or text | what defines the task |
| run | text | of the part |
| episode, time | int32 | number of the episode in the file, and of the row in it |
| observation, next_observation | list of float32, of a fixed length | |
| action | list of float32, of a fixed length | as executed, in [-1, 1] |
| reward | float32 | |
| terminated, truncated | bool | the task's end, and the time limit |
| success … | as stored | further per-step arrays |

The schema's metadata has under `tcmrl` a JSON object that names task, environment and dataset. Several files
open as one table, since all have the columns in the same order.

For reading, the columns `episode`, `observation`, `action`, `reward`, `next_observation`, `terminated` and
`truncated` are needed; the rows of an episode stand behind one another. `step` is 0 without it. Further
columns of numbers become per-step arrays. One file is one task.
"""

import contextlib
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import named_errors
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.records import leaves
from tcmrl_data.interchange.exporting import REMEDY, Format, transitions
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    FileTask,
    Reader,
    ReadPart,
    Say,
    damage_at,
    decoded_limit,
    described_task,
    parts_of_task,
    require_file,
    stored_episode,
)
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    import pyarrow

METADATA_KEY = "tcmrl"
GROUP_ROWS = 2**16
"""Rows of a row group, or up to a part more: what is in memory at a time."""

INDEX_COLUMNS = ["task", "split", "step", "run", "episode", "time"]
SETTINGS = {"compression": "zstd", "use_dictionary": INDEX_COLUMNS, "write_statistics": INDEX_COLUMNS}

COLUMNS = {
    "observations": "observation",
    "actions": "action",
    "rewards": "reward",
    "next_observations": "next_observation",
    "terminated": "terminated",
    "truncated": "truncated",
}
"""Of the arrays of an episode."""

NEEDED = ("episode", *COLUMNS.values())
STEP = "step"
UNUSED = ("task", "split", "run", "time")
"""What the metadata and the order of rows say too, or a dataset has no place for."""

PARAMETER = "parameter_"
"""Begins the names of the columns with the task's parameters."""

BATCH_ROWS = 2**12
ITEM_BYTES = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4}
"""Bytes of a decoded value by its physical type; 8 for any other."""

Rows = Mapping[str, npt.NDArray[Any]]
"""Columns by name, of (rows,), or of (rows, width) where they hold lists."""


@final
class ParquetFormat(Format):
    """One file per task; an episode without steps is a `StoreError`."""

    name = "parquet"
    suffix = ".parquet"
    optional_packages = ("pyarrow",)
    extra = "tcmrl[parquet]"

    def place(self, selection: Selection, task: Task) -> str:
        return f"{task.split}/{super().place(selection, task)}"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        from pyarrow import concat_tables, parquet

        metadata = {METADATA_KEY: json.dumps(self.attributes(selection, task))}
        writer: parquet.ParquetWriter | None = None
        waiting: list[pyarrow.Table] = []
        episodes = 0
        with named_errors(path, remedy=REMEDY), contextlib.ExitStack() as stack:
            file = stack.enter_context(path.open("xb"))
            for key, trajectories in self.parts(selection, task, path):
                waiting.append(_table(trajectories, task, key, first=episodes))
                episodes += len(trajectories)
                if writer is None:
                    schema = waiting[0].schema.with_metadata(metadata)
                    writer = stack.enter_context(parquet.ParquetWriter(file, schema, **SETTINGS))
                if sum(map(len, waiting)) >= GROUP_ROWS:
                    writer.write_table(concat_tables(waiting))
                    waiting = []
                yield key
            if writer is not None and waiting:
                writer.write_table(concat_tables(waiting))


def _table(trajectories: Sequence[Trajectory], task: Task, key: PartKey, *, first: int) -> "pyarrow.Table":
    """The rows of a part; `first` numbers its first episode."""
    import pyarrow

    arrays = transitions(trajectories, first=first, step=key.step)
    episode, step = (arrays.pop(name).astype(np.int32) for name in ("episode", "step"))
    every_row = pyarrow.array(np.zeros_like(step))
    columns = {
        "task": pyarrow.array(np.full_like(step, key.task)),
        "split": pyarrow.array([task.split]).take(every_row),
        "step": pyarrow.array(step),
        "run": pyarrow.array([key.run]).take(every_row),
        "episode": pyarrow.array(episode),
        "time": pyarrow.array(np.concatenate([np.arange(len(one), dtype=np.int32) for one in trajectories])),
    }
    for name in dict.fromkeys([*COLUMNS, *arrays]):
        array = arrays[name]
        columns[COLUMNS.get(name, name)] = _lists(array) if array.ndim == 2 else pyarrow.array(array)
    for name, value in parameter_columns(task).items():
        columns[name] = pyarrow.array([value]).take(every_row)
    fields = [pyarrow.field(name, column.type, nullable=False) for name, column in columns.items()]
    return pyarrow.table(columns, schema=pyarrow.schema(fields))


def parameter_columns(task: Task) -> dict[str, float | list[float] | str]:
    """The task's parameters by column; whole numbers too become floats, so that all tasks have one type."""
    values: dict[str, float | list[float] | str] = {}
    for path, value in leaves(task.parameters):
        numbers = value if isinstance(value, list | tuple) else [value]
        if isinstance(value, str):
            made: float | list[float] | str = value
        elif all(isinstance(number, int | float) for number in numbers):
            made = float(value) if numbers == [value] else [float(number) for number in numbers]
        else:
            made = json.dumps(value)
        values[PARAMETER + "_".join(path)] = made
    return values


def episode_rows(files: Sequence[Path]) -> list[dict[str, Any]]:
    """A row per episode of exported files: its part, length, undiscounted return and how it ended."""
    from pyarrow import parquet

    keys = ["task", "split", "step", "run", "episode"]
    rows: list[dict[str, Any]] = []
    for file in files:
        steps = parquet.read_table(file, columns=[*keys, "reward", "terminated", "truncated"])
        episodes = steps.group_by(keys).aggregate(
            [("reward", "count"), ("reward", "sum"), ("terminated", "any"), ("truncated", "any")]
        )
        episodes = episodes.sort_by("episode")
        names = {"reward_count": "length", "reward_sum": "return"}
        names |= {"terminated_any": "terminated", "truncated_any": "truncated"}
        rows += episodes.rename_columns([names.get(name, name) for name in episodes.column_names]).to_pylist()
    return rows


def table_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """A small table as a file; a column of None becomes one of numbers, as it is where they are known."""
    import pyarrow
    from pyarrow import parquet

    made = pyarrow.BufferOutputStream()
    table = pyarrow.Table.from_pylist(list(rows))
    known = [
        field.with_type(pyarrow.float64()) if pyarrow.types.is_null(field.type) else field
        for field in table.schema
    ]
    parquet.write_table(table.cast(pyarrow.schema(known)), made, compression=SETTINGS["compression"])
    return bytes(made.getvalue())


def dataset_root(file: Path) -> str:
    """The root of the dataset that an exported file is from."""
    from pyarrow import parquet

    metadata = parquet.read_schema(file).metadata or {}
    return str(json.loads(metadata[METADATA_KEY.encode()])["dataset_root"])


def _lists(rows: npt.NDArray[np.float32]) -> "pyarrow.Array":
    """Rows of equal width as lists."""
    import pyarrow

    kind = pyarrow.list_(pyarrow.field("element", pyarrow.float32(), nullable=False), rows.shape[1])
    return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(rows.ravel()), type=kind)


@final
class ParquetReader(Reader):
    """One file is one task."""

    name = "parquet"
    optional_packages = ("pyarrow",)
    extra = "tcmrl[parquet]"

    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        from pyarrow import parquet

        limit = decoded_limit(require_file(path).stat().st_size)
        with damage_at(f"{path} does not open as Parquet:"):
            file = parquet.ParquetFile(path)
        names = [
            field.name
            for field in file.schema_arrow
            if _holds_numbers(field.type) and not field.name.startswith(PARAMETER)
        ]
        missing = [name for name in NEEDED if name not in names]
        if missing:
            raise StoreError(f"{path}: has no column {missing[0]} of numbers, which a row a transition has")
        with damage_at(f"{path}: metadata tcmrl:"):
            text = ((file.schema_arrow.metadata or {}).get(METADATA_KEY.encode()) or b"").decode()
        task = described_task(text, place=str(path)) if text else FileTask()
        cuts = EpisodeCuts()
        batches = _batches(file, [name for name in names if name not in UNUSED], limit, path)
        episodes = (
            (step, _episode(rows, cuts, place=f"{path}: episode {number}"))
            for (step, number), rows in _by_episode(batches, path)
        )
        yield from parts_of_task(episodes, task, place=str(path))
        cuts.tell(say, path)


def _batches(file: Any, names: Sequence[str], limit: int, path: Path) -> Iterator[Rows]:
    """The rows, some thousands at a time.

    Raises:
        StoreError: the values are more than the file's size justifies, or no table of numbers.
    """
    with damage_at(f"{path}:"):
        groups = [file.metadata.row_group(index) for index in range(file.metadata.num_row_groups)]
        chunks = [group.column(index) for group in groups for index in range(group.num_columns)]
        used = [chunk for chunk in chunks if chunk.path_in_schema.partition(".")[0] in names]
        if any(chunk.file_path for chunk in used):
            raise ValueError("has columns in other files")
        _check_size(sum(chunk.num_values * ITEM_BYTES.get(chunk.physical_type, 8) for chunk in used), limit)
        decoded = 0
        widths: dict[str, int] = {}
        for batch in file.iter_batches(BATCH_ROWS, columns=list(names), use_threads=False):
            made = {name: _numbers(batch.column(name), name, widths) for name in names}
            decoded += sum(array.nbytes for array in made.values())
            _check_size(decoded, limit)
            yield made


def _check_size(num_bytes: int, limit: int) -> None:
    if num_bytes > limit:
        raise ValueError(
            "has more values than the file's size justifies; if you trust the file, write it again without "
            "compression"
        )


def _holds_numbers(kind: Any) -> bool:
    from pyarrow import types

    is_list = types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
    item = kind.value_type if is_list else kind
    return bool(types.is_integer(item) or types.is_floating(item) or types.is_boolean(item))


def _numbers(column: Any, name: str, widths: dict[str, int]) -> npt.NDArray[Any]:
    """The values of a column, whose lists have the width that `widths` knows or, the first time, learns."""
    from pyarrow import compute, types

    is_list = not types.is_primitive(column.type)
    values = column.flatten() if is_list else column
    if column.null_count or values.null_count:
        raise ValueError(f"{name} lacks values")
    found = np.asarray(values.to_numpy(zero_copy_only=False))
    if not is_list:
        return found
    lengths = compute.list_value_length(column).unique().to_pylist()
    if len(lengths) != 1 or lengths[0] != widths.setdefault(name, lengths[0]):
        raise ValueError(f"{name} has lists of different lengths")
    return found.reshape(len(column), lengths[0])


def _by_episode(batches: Iterable[Rows], path: Path) -> Iterator[tuple[tuple[int, int], Rows]]:
    """The rows of every episode, with its snapshot's step and its number."""
    waiting: list[Rows] = []
    before: tuple[int, int] | None = None
    for batch in batches:
        numbers = batch["episode"]
        steps = batch.get(STEP, np.zeros(len(numbers), np.int64))
        if {numbers.dtype.kind, steps.dtype.kind} - set("iu") or numbers.ndim != 1 or steps.ndim != 1:
            raise StoreError(f"{path}: columns episode and step are no integers")
        starts = np.flatnonzero((numbers[1:] != numbers[:-1]) | (steps[1:] != steps[:-1])) + 1
        for start, stop in itertools.pairwise([0, *starts.tolist(), len(numbers)]):
            if start == stop:
                continue
            key = (int(steps[start]), int(numbers[start]))
            if before is not None and key != before:
                yield before, _joined(waiting)
                waiting = []
            before = key
            waiting.append({name: array[start:stop] for name, array in batch.items()})
    if before is not None:
        yield before, _joined(waiting)


def _joined(pieces: list[Rows]) -> Rows:
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _episode(rows: Rows, cuts: EpisodeCuts, *, place: str) -> Trajectory:
    for name in ("observation", "action", "next_observation"):
        if rows[name].ndim != 2:
            raise StoreError(f"{place}: column {name} has no lists")
    arrays = {name: array for name, array in rows.items() if name not in (*NEEDED, STEP)}
    arrays |= {name: rows[column] for name, column in COLUMNS.items()}
    return stored_episode(arrays, cuts=cuts, place=place)
