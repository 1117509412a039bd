"""Parquet, one file per task, `task_00000.parquet` and so on: one row a transition.

| column | type | holds |
|---|---|---|
| task, step | int32 | index of the task, and the snapshot's training step |
| run | text | of the part |
| episode, time | int32 | number of the episode in the file, and of the row in it |
| observation, next_observation | list of float32, of a fixed length | |
| action | list of float32, of a fixed length | as executed, in [-1, 1] |
| reward | float32 | |
| terminated, truncated | bool | the task's end, and the time limit |
| success … | as stored | further per-step arrays |

The schema's metadata has under `tcmrl` a JSON object that names task, environment and dataset. Several files
open as one table, since all have the columns in the same order.
"""

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.disk import named_errors
from tcmrl_data.interchange.formats.base import Format
from tcmrl_data.interchange.formats.describing import stored_episodes, task_attributes
from tcmrl_data.interchange.formats.new_folder import REMEDY, require_room_for
from tcmrl_data.store.keys import PartKey

if TYPE_CHECKING:
    import pyarrow

LAYOUT, FORMAT_VERSION = "tcmrl-parquet", 1
METADATA_KEY = "tcmrl"
GROUP_ROWS = 2**16
"""Rows of a row group, or up to a part more: what is in memory at a time."""

INDEX_COLUMNS = ["task", "step", "run", "episode", "time"]
SETTINGS = {"compression": "zstd", "use_dictionary": INDEX_COLUMNS, "write_statistics": INDEX_COLUMNS}


@final
class ParquetFormat(Format):
    """One file per task; an episode without steps is a `StoreError`."""

    name = "parquet"
    optional_packages = ("pyarrow",)
    extra = "tcmrl[parquet]"

    def place(self, selection: Selection, task: Task) -> str:
        return f"task_{task.index:05d}.parquet"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        from pyarrow import concat_tables, parquet

        attributes = task_attributes(selection, task, layout=LAYOUT, version=FORMAT_VERSION)
        writer: parquet.ParquetWriter | None = None
        waiting: list[pyarrow.Table] = []
        episodes = 0
        require_room_for(path)
        with named_errors(path, remedy=REMEDY), contextlib.ExitStack() as stack:
            file = stack.enter_context(path.open("xb"))
            for key in selection.parts[task.index]:
                trajectories = stored_episodes(selection.dataset, key, format_name="Parquet")
                require_room_for(path, trajectories)
                waiting.append(_table(trajectories, key, first=episodes))
                episodes += len(trajectories)
                if writer is None:
                    schema = waiting[0].schema.with_metadata({METADATA_KEY: json.dumps(attributes)})
                    writer = stack.enter_context(parquet.ParquetWriter(file, schema, **SETTINGS))
                if sum(map(len, waiting)) >= GROUP_ROWS:
                    writer.write_table(concat_tables(waiting))
                    waiting = []
                yield key
            if writer is not None and waiting:
                writer.write_table(concat_tables(waiting))


def _table(trajectories: Sequence[Trajectory], key: PartKey, *, first: int) -> "pyarrow.Table":
    """The rows of a part; `first` numbers its first episode."""
    import pyarrow

    lengths = [len(trajectory) for trajectory in trajectories]
    rows = sum(lengths)
    observations = [trajectory.observations for trajectory in trajectories]
    columns = {
        "task": pyarrow.array(np.full(rows, key.task, np.int32)),
        "step": pyarrow.array(np.full(rows, key.step, np.int32)),
        "run": pyarrow.array([key.run]).take(pyarrow.array(np.zeros(rows, np.int8))),
        "episode": pyarrow.array(np.repeat(np.arange(first, first + len(lengths), dtype=np.int32), lengths)),
        "time": pyarrow.array(np.concatenate([np.arange(length, dtype=np.int32) for length in lengths])),
        "observation": _lists([rows[:-1] for rows in observations]),
        "action": _lists([trajectory.actions for trajectory in trajectories]),
        "reward": pyarrow.array(np.concatenate([trajectory.rewards for trajectory in trajectories])),
        "next_observation": _lists([rows[1:] for rows in observations]),
        "terminated": pyarrow.array(np.concatenate([trajectory.terminated for trajectory in trajectories])),
        "truncated": pyarrow.array(np.concatenate([trajectory.truncated for trajectory in trajectories])),
    }
    for name in trajectories[0].extras:
        columns[name] = pyarrow.array(
            np.concatenate([trajectory.extras[name] for trajectory in trajectories])
        )
    fields = [pyarrow.field(name, column.type, nullable=False) for name, column in columns.items()]
    return pyarrow.table(columns, schema=pyarrow.schema(fields))


def _lists(arrays: Sequence[npt.NDArray[np.float32]]) -> "pyarrow.Array":
    """Rows of equal width as lists."""
    import pyarrow

    rows = np.concatenate(arrays)
    kind = pyarrow.list_(pyarrow.field("element", pyarrow.float32(), nullable=False), rows.shape[1])
    return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(rows.ravel()), type=kind)
