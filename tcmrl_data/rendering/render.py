"""`render_episode`: a film or a strip of pictures of a stored episode."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Picture
from tcmrl_data.envs.tasks import place_in_order
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import RenderingError, SelectionError, SimulationError
from tcmrl_data.rendering.captions import bar_height, captioned, line_of_words
from tcmrl_data.rendering.filming import Frame, film
from tcmrl_data.rendering.picture_files import STRIP_ENDING, check_ending, encode
from tcmrl_data.rendering.stored_episode import StoredEpisode, find_episode
from tcmrl_data.store.keys import MAIN_RUN, PartKey
from tcmrl_data.store.platform import this_platform

FILM_FRAMES, STRIP_FRAMES = 100, 5
"""Frames of a film and of a strip where no number is given."""

MAX_FRAMES = 500
GAP = 4
"""Between stills, in pixels."""
SMALLEST_WIDTH, DEFAULT_WIDTH, LARGEST_WIDTH = 64, 320, 640


@dataclass(frozen=True)
class Rendered:
    """What was drawn.

    Attributes:
        file: that was written.
        task, step, run, episode: the episode.
        steps: its length.
        reward: its undiscounted return.
        frames: number of pictures in the file.
        bytes: size of the file.
    """

    file: Path
    task: int
    step: int
    run: str
    episode: int
    steps: int
    reward: float
    frames: int
    bytes: int


def render_episode(
    path: str | Path | Dataset,
    out: str | Path,
    *,
    task: int,
    step: int | None = None,
    episode: int = 0,
    run: str = MAIN_RUN,
    frames: int | None = None,
    width: int = DEFAULT_WIDTH,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Rendered:
    """Draws a stored episode by playing its actions again from its seed.

    Every observation, reward and end must come back bit for bit, or nothing is written.

    Args:
        path: a dataset or a view.
        out: file to write: `.webp` or `.mp4` for a film, `.png` for a strip of stills.
        task: index of the task.
        step: snapshot step; the task's last one where None.
        episode: position in the part.
        run: name of the run.
        frames: most pictures, evenly spread over the episode; 100 of a film and 5 of a strip where None.
        width: of a picture in pixels; its height is three quarters of it.
        progress: called with steps done and steps in all.

    Raises:
        SelectionError: the dataset has no such task, snapshot or episode.
        RenderingError: the episode's seed is not known, its environment has no picture, this machine cannot
            draw it, or the file's ending is not known.
        SimulationError: the episode does not come back; names the first step that differs.
        StoreError: the part is damaged.

    Example:
        >>> import tcmrl_data
        >>> tcmrl_data.render_episode("data/demo", "task-3.webp", task=3).frames  # doctest: +SKIP
        21
    """
    out = Path(out)
    check_ending(out)
    _check_sizes(frames, width)
    dataset = path if isinstance(path, Dataset) else open_dataset(path)
    key = _find_part(dataset, task, step, run)
    stored = find_episode(dataset, key, episode)
    is_strip = out.suffix.lower() == STRIP_ENDING
    width -= width % 4  # so that height and width are even
    taken = _film(
        dataset, stored, frames or (STRIP_FRAMES if is_strip else FILM_FRAMES), width, progress=progress
    )
    titles = _titles(dataset, stored)
    pictures = (
        [_strip(taken, ", ".join(titles))] if is_strip else [_film_frame(frame, titles) for frame in taken]
    )
    content = encode(pictures, out.suffix.lower())
    replace_file(out, content)
    trajectory = stored.trajectory
    return Rendered(
        file=out,
        task=key.task,
        step=key.step,
        run=key.run,
        episode=episode,
        steps=len(trajectory),
        reward=trajectory.undiscounted_return,
        frames=len(taken),
        bytes=len(content),
    )


def _check_sizes(frames: int | None, width: int) -> None:
    if frames is not None and not 1 <= frames <= MAX_FRAMES:
        raise RenderingError(f"frames {frames} is not between 1 and {MAX_FRAMES}; choose another number")
    if not SMALLEST_WIDTH <= width <= LARGEST_WIDTH:
        raise RenderingError(
            f"width {width} is not between {SMALLEST_WIDTH} and {LARGEST_WIDTH} pixels; choose another one"
        )


def _find_part(dataset: Dataset, task: int, step: int | None, run: str) -> PartKey:
    """The part of a task, snapshot and run.

    Raises:
        SelectionError: there is none; names the steps that there are.
        TaskError: the dataset does not hold the task.
    """
    steps = [key.step for key in dataset.parts.keys_of(dataset.task(task).index) if key.run == run]
    wanted = max(steps, default=0) if step is None else step
    if wanted not in steps:
        found = f"its steps are {sorted(steps)}" if steps else "it has no part of that run"
        raise SelectionError(f"{dataset.path}: task {task} has no snapshot {wanted} of run {run}; {found}")
    return PartKey(task, wanted, run)


def _film(
    dataset: Dataset,
    episode: StoredEpisode,
    frames: int,
    width: int,
    *,
    progress: Callable[[int, int], None],
) -> list[Frame]:
    """Films an episode; if it does not come back, says whether another platform may be the reason."""
    try:
        return film(
            dataset.environment,
            episode,
            frames=frames,
            width=width,
            height=3 * width // 4,
            progress=progress,
        )
    except SimulationError as error:
        made_on = dataset.manifest.platforms[dataset.entry(episode.key).platform]
        here = this_platform(dataset.environment, dataset.manifest.recipe.behavior.source)
        differences = "; ".join(here.differences(made_on))
        remedy = (
            f"it was made on another platform ({differences[:200]}), draw it there"
            if differences
            else f"run `tcmrl-data verify {dataset.path} --deep`"
        )
        raise SimulationError(f"{dataset.path}: {error}; {remedy}") from None


def _titles(dataset: Dataset, episode: StoredEpisode) -> tuple[str, str]:
    """Which task it is, with its place among others where they have an order, and which episode."""
    environment, task = dataset.environment, dataset.task(episode.key.task)
    place = place_in_order(environment, task)
    order = "" if place is None else f", {environment.ordering_name} = {place:.2f}"
    run = "" if episode.key.run == MAIN_RUN else f", run {episode.key.run}"
    return (
        f"{dataset.name}, task {task.index}{order}",
        f"snapshot {episode.key.step:,}{run}, episode {episode.number}",
    )


def _film_frame(frame: Frame, titles: Sequence[str]) -> Picture:
    """A frame below its titles, one a line, since it is narrow."""
    width = frame.picture.shape[1]
    bars = [line_of_words(title, width, bar_height(width)) for title in titles]
    return np.concatenate([*bars, _still(frame)])


def _strip(frames: Sequence[Frame], title: str) -> Picture:
    """All frames side by side, with gaps, below their title."""
    gap = ((0, 0), (0, GAP), (0, 0))
    stills = np.concatenate([np.pad(_still(frame), gap, constant_values=255) for frame in frames], axis=1)
    height = bar_height(frames[0].picture.shape[1])
    return np.concatenate([line_of_words(title, stills.shape[1], height), stills])


def _still(frame: Frame) -> Picture:
    return captioned(frame.picture, f"step {frame.steps:,}, return {frame.reward:,.2f}")
