"""Pictures of episodes in a report, each a strip of stills of one task's last snapshot."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import RenderingError, SimulationError
from tcmrl_data.quality.transfer import last_part
from tcmrl_data.rendering.render import render_episode
from tcmrl_data.report.evenly import evenly

STRIP_WIDTH = 240
"""Width of a still in pixels."""


@dataclass(frozen=True)
class Strip:
    """One episode in stills.

    Attributes:
        caption: its task, snapshot, and return.
        content: a PNG file.
    """

    caption: str
    content: bytes


@dataclass(frozen=True)
class Strips:
    """The strips that could be drawn.

    Attributes:
        drawn: the strips.
        reason: why there are not more, where one could not be drawn.
    """

    drawn: tuple[Strip, ...]
    reason: str | None = None


def film_strips(
    dataset: Dataset, tasks: Sequence[Task], count: int, *, progress: Callable[[int, int], None]
) -> Strips:
    """Draws the first episode of the last snapshot of evenly chosen tasks, until one cannot be drawn.

    Args:
        dataset: the dataset.
        tasks: of which `count` are chosen.
        count: most strips.
        progress: called with strips done and strips in all.

    Raises:
        StoreError: a part is damaged.
    """
    drawn: list[Strip] = []
    chosen = evenly(tasks, count)
    with tempfile.TemporaryDirectory() as folder:
        for task in chosen:
            key = last_part(dataset, task)
            file = Path(folder) / f"{task.index}.png"
            try:
                found = render_episode(
                    dataset, file, task=key.task, step=key.step, run=key.run, width=STRIP_WIDTH
                )
            except (RenderingError, SimulationError) as error:
                return Strips(tuple(drawn), str(error))
            caption = (
                f"Task {task.index} ({task.split}), step {found.step:,}, first episode: {found.steps:,} "
                f"steps, return {found.reward:.4g}. Played again from its seed, with equal observations."
            )
            drawn.append(Strip(caption, file.read_bytes()))
            progress(len(drawn), len(chosen))
    return Strips(tuple(drawn))
