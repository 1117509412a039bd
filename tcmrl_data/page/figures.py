"""What a figure shows, whichever library draws it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]
Line = Literal["solid", "dash", "dot", "none"]

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#444444", "#8C6D1F")
"""Okabe and Ito's palette, which the color-blind can tell apart, without its light yellow."""

GRAY = 6
"""Index of the palette's dark gray, for references."""

_NAME = re.compile(r"[a-z][a-z0-9-]*")


@dataclass(frozen=True)
class Series:
    """Points that belong together.

    Attributes:
        x: (points,); 0, 1, … where None.
        y: (points,); NaN interrupts a line.
        name: in the legend; none where empty.
        group: series of a group are hidden and shown together.
        label: what the reader sees who points at it; the name where empty.
        color: index of `COLORS`.
        line: how the points are connected.
        markers: whether the points are drawn.
        bars: draw a bar per point instead.
        width: of the line, in pixels.
        opacity: from 0 to 1.
        row: which of the figure's vertical axes the points belong to.
    """

    x: Values | None
    y: Values
    name: str = ""
    group: str = ""
    label: str = ""
    color: int = 0
    line: Line = "solid"
    markers: bool = False
    bars: bool = False
    width: float = 2.0
    opacity: float = 1.0
    row: int = 0

    @property
    def places(self) -> Values:
        """`x`, counted where it is None."""
        return np.arange(len(self.y)) if self.x is None else self.x


@dataclass(frozen=True)
class Cells:
    """A heat map.

    Attributes:
        z: (rows, columns), the first row at the bottom; NaN is blank.
        unit: of the values, for the color bar.
        is_count: values are whole numbers, colored by their logarithm; 0 is blank.
        low: value of the first color; the smallest value where None.
        high: value of the last color; the largest value where None.
    """

    z: Values
    unit: str
    is_count: bool = False
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Frame:
    """What a figure shows at one place of its slider.

    Attributes:
        label: the place in words, such as `task 7 (test)`.
        series: points to draw.
        cells: a heat map under them.
    """

    label: str
    series: tuple[Series, ...] = ()
    cells: Cells | None = None


@dataclass(frozen=True)
class Axis:
    """An axis of a figure.

    Attributes:
        label: what it measures, with the unit.
        low: its first value; chosen by the library where None.
        high: its last value.
        ticks: place to text, where numbers do not say it.
        is_log: whether equal distances are equal factors.
    """

    label: str
    low: float | None = None
    high: float | None = None
    ticks: Mapping[float, str] | None = None
    is_log: bool = False


@dataclass(frozen=True)
class Figure:
    """A figure with a slider over its frames, if it has several.

    Attributes:
        name: unique in its page; lower-case letters, digits and hyphens.
        caption: what the reader sees, in a sentence or two.
        x: the horizontal axis.
        y: the vertical axis.
        below: further vertical axes under it, which share the horizontal one.
        frames: at least one.
        slider: what the slider goes through, such as `task`.
        is_square: both axes have the same scale.
        height: in pixels.
        start: place of the slider at first.
    """

    name: str
    caption: str
    x: Axis
    y: Axis
    frames: tuple[Frame, ...]
    slider: str = ""
    is_square: bool = False
    height: int = 420
    below: tuple[Axis, ...] = ()
    start: int = 0

    def __post_init__(self) -> None:
        assert _NAME.fullmatch(self.name) and self.frames, self.name
