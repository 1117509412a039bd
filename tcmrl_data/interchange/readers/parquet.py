"""Parquet with one row a transition, as `tcmrl-data export --format parquet` writes it.

Needed are the columns `episode`, `observation`, `action`, `reward`, `next_observation`, `terminated` and
`truncated`; the rows of an episode stand behind one another. `step` is the snapshot's step, 0 without it.
Further columns of numbers become per-step arrays. One file is one task, which its metadata name.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.interchange.formats.parquet import FORMAT_VERSION, METADATA_KEY
from tcmrl_data.interchange.readers.base import (
    FileTask,
    Reader,
    ReadPart,
    Say,
    described_task,
    say_nothing,
)
from tcmrl_data.interchange.readers.episodes import (
    Cuts,
    episode,
    extras_of,
    joined_observations,
    last_flags,
    parts_by_step,
)
from tcmrl_data.interchange.readers.parquet_file import ParquetFile
from tcmrl_data.interchange.readers.source_files import require_file

Rows = Mapping[str, npt.NDArray[Any]]

NEEDED = ("episode", "observation", "action", "reward", "next_observation", "terminated", "truncated")
STEP = "step"
UNUSED = ("task", "run", "time")
"""What the metadata and the order of rows say too, or a dataset has no place for."""


@final
class ParquetReader(Reader):
    """One file is one task."""

    name = "parquet"
    optional_packages = ("pyarrow",)
    extra = "tcmrl[parquet]"

    def files(self, path: Path) -> list[Path]:
        return [require_file(path)]

    def read(self, path: Path, say: Say = say_nothing) -> Iterator[ReadPart]:
        file = ParquetFile(path)
        missing = [name for name in NEEDED if name not in file.names]
        if missing:
            raise StoreError(f"{path}: has no column {missing[0]} of numbers, which a row a transition has")
        task, about = _task(file)
        cuts = Cuts()
        rows = file.batches([name for name in file.names if name not in UNUSED])
        episodes = (
            (step, _episode(arrays, cuts, place=str(path))) for step, arrays in _by_episode(rows, path)
        )
        for step, trajectories in parts_by_step(episodes, place=str(path)):
            yield ReadPart(task, step, trajectories, about)
        for sentence in cuts.sentences():
            say(f"{path.name}: {sentence}")


def _task(file: ParquetFile) -> tuple[int | None, FileTask]:
    """The task that the metadata name; nothing without them."""
    text = file.text(METADATA_KEY)
    if text is None:
        return None, FileTask()
    return described_task(text, version=FORMAT_VERSION, place=str(file.path))


def _by_episode(batches: Iterable[Rows], path: Path) -> Iterator[tuple[int, Rows]]:
    """The rows of every episode, with its snapshot's step."""
    waiting: list[Rows] = []
    before: tuple[int, int] | None = None
    for batch in batches:
        numbers = batch["episode"]
        steps = batch.get(STEP, np.zeros(len(numbers), np.int64))
        if {numbers.dtype.kind, steps.dtype.kind} - set("iu") or numbers.ndim != 1 or steps.ndim != 1:
            raise StoreError(f"{path}: columns episode and step are no integers")
        starts = np.flatnonzero((numbers[1:] != numbers[:-1]) | (steps[1:] != steps[:-1])) + 1
        bounds = [0, *starts.tolist(), len(numbers)]
        for start, stop in itertools.pairwise(bounds):
            if start == stop:
                continue
            key = (int(steps[start]), int(numbers[start]))
            if before is not None and key != before:
                yield before[0], _joined(waiting)
                waiting = []
            before = key
            waiting.append({name: array[start:stop] for name, array in batch.items()})
    if before is not None:
        yield before[0], _joined(waiting)


def _joined(pieces: list[Rows]) -> Rows:
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _episode(rows: Rows, cuts: Cuts, *, place: str) -> Trajectory:
    place = f"{place}: episode {int(rows['episode'][0])}"
    for name in ("observation", "action", "next_observation"):
        if rows[name].ndim != 2:
            raise StoreError(f"{place}: column {name} has no lists")
    further = {name: array for name, array in rows.items() if name not in (*NEEDED, STEP)}
    return episode(
        joined_observations(rows["observation"], rows["next_observation"], place=place),
        rows["action"],
        rows["reward"],
        ended=last_flags(rows["terminated"], rows["truncated"], place),
        extras=extras_of(further),
        cuts=cuts,
        place=place,
    )
