"""What all measures share: how records begin, passes over the parts of a dataset, and parts of pictures.

A number of a record is None where it is not defined: a score without reference returns, a ratio of two zeros.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.base import Split, Task
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.foundation.errors import SelectionError, StoreError
from tcmrl_data.foundation.records import Record
from tcmrl_data.foundation.seeding import evenly_spread
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SAMPLED_PARTS = 100
"""Parts, evenly spread over the dataset, from which scales and ranges of values are taken."""

SMALLEST_STD = 1e-6
"""Columns whose standard deviation is smaller do not vary."""

COLORS: dict[Split, str] = {"train": "tab:blue", "test": "tab:orange"}
STEPS_LABEL = "environment steps of behavior training"
TQ_LABEL = "trajectory quality (0 uniform, 1 best known)"

TICKS = 20
"""Most tasks that are named along an axis of a matrix."""


class Measured(Record):
    """The head of every document of `inspect --json`.

    Attributes:
        label: the dataset's own name, if it has one.
        root: of the dataset; equal data have an equal root.
    """

    label: str | None
    environment: str
    root: str


class MeasuredPart(Record):
    """One part: the training steps of its policy, and the name of its run."""

    step: int
    run: str


class MeasuredTask(Record):
    """One task; `snapshots`, where it has them, are its parts, ascending by step and run."""

    task: int
    split: Split


class MeasuredStage(Record):
    """All parts of one step of behavior training and one split."""

    step: int
    split: Split


Row = TypeVar("Row", bound=MeasuredPart | PartKey)


def heading(dataset: Dataset) -> dict[str, Any]:
    """What a record of the dataset begins with."""
    manifest = dataset.manifest
    return {"label": manifest.label, "environment": manifest.name, "root": manifest.root}


def by_stage(rows: Iterable[tuple[Split, Row]]) -> Iterator[tuple[int, Split, list[Row]]]:
    """Rows by step and split, ascending by step, training tasks before test tasks."""
    found: dict[tuple[int, Split], list[Row]] = {}
    for split, row in rows:
        found.setdefault((row.step, split), []).append(row)
    for step, split in sorted(found, key=lambda stage: (stage[0], stage[1] != "train")):
        yield step, split, found[step, split]


@dataclass(frozen=True)
class PartSteps:
    """All steps of a part, episode after episode, in double precision.

    Attributes:
        observations: (steps, observation_dim), before the step.
        actions: (steps, action_dim).
        next_observations: (steps, observation_dim), after the step.
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    next_observations: FloatArray
    lengths: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.rewards)


def read_steps(dataset: Dataset, key: PartKey) -> PartSteps:
    """The steps of a part.

    Raises:
        StoreError: the part is damaged, or a value is not finite.
    """
    trajectories = dataset.trajectories(*key)
    columns = {
        "observations": [trajectory.observations[:-1] for trajectory in trajectories],
        "actions": [trajectory.actions for trajectory in trajectories],
        "rewards": [trajectory.rewards for trajectory in trajectories],
        "next_observations": [trajectory.observations[1:] for trajectory in trajectories],
    }
    arrays = {name: np.concatenate(rows).astype(np.float64) for name, rows in columns.items()}
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise StoreError(
            f"{dataset.file_of(key)}: has values that are not finite; leave it out with `tcmrl-data derive`"
        )
    return PartSteps(**arrays, lengths=tuple(map(len, trajectories)))


def filled_parts(dataset: Dataset) -> list[PartKey]:
    """The keys of all parts that have steps, ascending."""
    table = dataset.parts
    keys = [key for key, steps in zip(table, table.columns["steps"], strict=True) if steps]
    if not keys:
        raise SelectionError(f"{dataset.path} has no steps to measure; build it with `tcmrl-data build`")
    return keys


def sampled_parts(dataset: Dataset) -> Iterator[PartSteps]:
    """The steps of at most SAMPLED_PARTS parts, evenly spread over the dataset."""
    return (read_steps(dataset, key) for key in evenly_spread(filled_parts(dataset), SAMPLED_PARTS))


def steps_by_task(
    dataset: Dataset, progress: Callable[[int, int], None] | None
) -> Iterator[tuple[Task, Iterator[tuple[PartKey, PartSteps]]]]:
    """Every task that has steps, and its parts, one in memory at a time; read them before the next task."""
    keys = filled_parts(dataset)
    done = itertools.count(1)

    def read(members: Iterable[PartKey]) -> Iterator[tuple[PartKey, PartSteps]]:
        for key in members:
            yield key, read_steps(dataset, key)
            if progress:
                progress(next(done), len(keys))

    for index, members in itertools.groupby(keys, key=lambda key: key.task):
        yield dataset.task(index), read(members)


def title(found: Measured) -> str:
    """What a picture calls its dataset."""
    return found.label or found.environment


def label_axes(axes: "Axes", heading: str, x: str, y: str) -> None:
    """Gives axes a title, labels and a light grid."""
    axes.set_title(heading)
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)


def draw_matrix(axes: "Axes", rows: Sequence[Sequence[float]], tasks: Sequence[int], label: str) -> None:
    """A matrix of tasks by tasks; at most TICKS of them are named."""
    image = axes.imshow(rows, cmap="viridis", interpolation="nearest")
    places = range(0, len(tasks), max(1, -(-len(tasks) // TICKS)))
    names = [str(tasks[place]) for place in places]
    axes.set_xticks(places, names, rotation=90, fontsize="small")
    axes.set_yticks(places, names, fontsize="small")
    axes.figure.colorbar(image, ax=axes, label=label)


PLOT_FORMATS = (".pdf", ".png", ".svg")
DOTS_PER_INCH = 130


def check_picture(file: Path) -> None:
    """Checks the name of a picture before the work that it shows.

    Raises:
        SelectionError: the ending names no supported format, or the folder does not exist.
    """
    if file.suffix.lower() not in PLOT_FORMATS:
        raise SelectionError(f"--plot {file}: the name must end in {', '.join(PLOT_FORMATS)}")
    if not file.parent.is_dir():
        raise SelectionError(f"--plot {file}: {file.parent} is not a folder; make it first")


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of so many inches, which opens no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.12)  # so that a color bar's label keeps off the next axes
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", file: Path) -> None:
    """Writes a figure; the ending of the name is its format."""
    check_picture(file)
    figure.savefig(file, dpi=DOTS_PER_INCH)
