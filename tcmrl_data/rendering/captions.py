"""Words above and below pictures."""

import functools
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.envs.base import Picture

BAR, LEAST_BAR = 0.056, 14
"""Height of a line of words as a share of the width of a frame, and its least in pixels."""

INK = (40, 40, 40)


def line_of_words(text: str, width: int, height: int) -> Picture:
    """A line of words on white, in letters that are small enough for it.

    Args:
        text: the words.
        width: in pixels.
        height: in pixels.
    """
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    for points in range(max(6, round(0.68 * height)), 4, -1):
        font = _font(points)
        if draw.textlength(text, font=font) <= width - 8:
            break
    draw.text((4, height / 2), text, fill=INK, font=font, anchor="lm")
    return np.asarray(image)


def captioned(picture: Picture, text: str) -> Picture:
    """A picture with a line of words below it."""
    width = picture.shape[1]
    return np.concatenate([picture, line_of_words(text, width, bar_height(width))])


def bar_height(width: int) -> int:
    """Height of a line of words for frames of a width, in pixels; even, as films need it."""
    return max(2 * round(BAR * width / 2), LEAST_BAR)


@functools.cache
def _font(points: int) -> Any:
    """The sans serif letters that matplotlib brings along."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(Path(get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), points)
