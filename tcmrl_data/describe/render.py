"""`render_episode`: a stored episode as an animated WebP or GIF, or a strip of stills as PNG."""

import functools
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.describe.film import Frame, StoredEpisode, film, find_episode
from tcmrl_data.envs.base import Picture, place_in_order
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import RenderingError, SelectionError, SimulationError
from tcmrl_data.store.part import this_platform
from tcmrl_data.store.tables import MAIN_RUN, PartKey

ENDINGS = (".webp", ".png", ".gif")
STRIP_ENDING = ".png"

FILM_MS = 4_000
"""A film takes about four seconds, however long its episode is, …"""
SHORTEST_MS, LONGEST_MS = 25, 200
"""… unless its frames would stand for less or more than this."""
LAST_MS = 1_000
"""The last frame stands longer, so that one sees how the episode ended."""

WEBP_QUALITY = 50
STRIP_COLORS = 128

FILM_FRAMES, STRIP_FRAMES = 100, 5
"""Frames of a film and of a strip where no number is given."""

MAX_FRAMES = 500
GAP = 4
"""Between stills, in pixels."""
SMALLEST_WIDTH, DEFAULT_WIDTH, LARGEST_WIDTH = 64, 320, 640

BAR, LEAST_BAR = 0.056, 14
"""Height of a line of words as a share of the width of a frame, and its least in pixels."""

INK = (40, 40, 40)


@dataclass(frozen=True)
class Rendered:
    """The file that was written, and the episode that it shows; `reward` is its undiscounted return."""

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
    progress: Callable[[int, int], None] | None = None,
) -> Rendered:
    """Draws a stored episode by playing its actions again from its seed.

    Every observation, reward and end must come back bit for bit, or nothing is written.

    Args:
        out: file to write: `.webp` or `.gif` for a film, `.png` for a strip of stills.
        step: snapshot step; the task's last one where None.
        frames: most pictures, evenly spread over the episode; 100 of a film and 5 of a strip where None.
        width: of a picture in pixels; its height is three quarters of it.

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
    _check_ending(out)
    _check_sizes(frames, width)
    dataset = path if isinstance(path, Dataset) else open_dataset(path)
    key = _find_part(dataset, task, step, run)
    stored = find_episode(dataset, key, episode)
    is_strip = out.suffix.lower() == STRIP_ENDING
    width -= width % 4  # so that the height is three quarters of it
    taken = _film(
        dataset, stored, frames or (STRIP_FRAMES if is_strip else FILM_FRAMES), width, progress=progress
    )
    titles = _titles(dataset, stored)
    pictures = (
        [_strip(taken, ", ".join(titles))] if is_strip else [_film_frame(frame, titles) for frame in taken]
    )
    content = _encode(pictures, out.suffix.lower())
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
    progress: Callable[[int, int], None] | None,
) -> list[Frame]:
    """Films an episode; if it does not come back, says whether another platform may be the reason."""
    try:
        return film(dataset.environment, episode, frames=frames, width=width, progress=progress)
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
    width = frame.picture.shape[1]
    bars = [_line_of_words(title, width, _bar_height(width)) for title in titles]
    return np.concatenate([*bars, _still(frame)])


def _strip(frames: Sequence[Frame], title: str) -> Picture:
    gap = ((0, 0), (0, GAP), (0, 0))
    stills = np.concatenate([np.pad(_still(frame), gap, constant_values=255) for frame in frames], axis=1)
    height = _bar_height(frames[0].picture.shape[1])
    return np.concatenate([_line_of_words(title, stills.shape[1], height), stills])


def _still(frame: Frame) -> Picture:
    width = frame.picture.shape[1]
    words = f"step {frame.steps:,}, return {frame.reward:,.2f}"
    return np.concatenate([frame.picture, _line_of_words(words, width, _bar_height(width))])


def _check_ending(file: Path) -> None:
    if file.suffix.lower() not in ENDINGS:
        raise RenderingError(f"--out {file}: the name must end in {', '.join(ENDINGS)}")


def _encode(pictures: Sequence[Picture], ending: str) -> bytes:
    """The bytes of a file.

    Args:
        pictures: of a film in order, all of one size; of a strip, the finished strip alone.
    """
    from PIL import Image

    first, *others = [Image.fromarray(picture) for picture in pictures]
    target = io.BytesIO()
    if ending == STRIP_ENDING:  # with a palette a third of the size of one without
        first.quantize(STRIP_COLORS, dither=Image.Dither.NONE).save(target, "PNG", optimize=True)
        return target.getvalue()
    shown = min(max(FILM_MS // len(pictures), SHORTEST_MS), LONGEST_MS)
    durations = [shown] * len(others) + [LAST_MS]
    options = {"quality": WEBP_QUALITY, "method": 4} if ending == ".webp" else {}
    first.save(target, ending[1:], save_all=True, append_images=others, duration=durations, loop=0, **options)
    return target.getvalue()


def _line_of_words(text: str, width: int, height: int) -> Picture:
    """A line of words on white, in letters that are small enough for it."""
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    for points in range(max(6, round(0.68 * height)), 4, -1):
        font = _font(points)
        if draw.textlength(text, font=font) <= width - 8:
            break
    draw.text((4, height / 2), text, fill=INK, font=font, anchor="lm")
    return np.asarray(image)


def _bar_height(width: int) -> int:
    """Height of a line of words for frames of a width, in pixels; even, as films need it."""
    return max(2 * round(BAR * width / 2), LEAST_BAR)


@functools.cache
def _font(points: int) -> Any:
    """The sans serif letters that matplotlib brings along."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(Path(get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), points)
