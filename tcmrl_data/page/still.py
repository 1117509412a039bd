"""Figures as SVG pictures by matplotlib, for pages without plotly.js."""

import base64
import io
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tcmrl_data.page.figures import COLORS, Axis, Cells, Figure, Frame, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANELS = 6
"""Frames of a figure that are drawn: a picture has no slider."""

LONGEST_TEXT = 38
"""Characters of a text along a panel."""

LONGEST_UPRIGHT = 26
"""Characters of a text up a panel, or over it."""

LONGEST_TICK = 12

STYLES = {"solid": "-", "dash": "--", "dot": ":", "none": ""}


def shown_frames(figure: Figure) -> tuple[Frame, ...]:
    """The frames that a picture shows: at most `PANELS`, evenly chosen, or one with several rows."""
    if figure.below:
        return figure.frames[figure.start : figure.start + 1]
    places = np.unique(np.linspace(0, len(figure.frames) - 1, PANELS).round().astype(int))
    return tuple(figure.frames[place] for place in places)


def figure_picture(figure: Figure) -> str:
    """A data URL of the figure's picture, a panel per shown frame."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    frames = shown_frames(figure)
    below = len(figure.below)
    columns = 1 if below else min(len(frames), 3)
    rows = 1 + below if below else -(-len(frames) // columns)
    size = (8.0, 4.0 + 1.5 * below) if columns == 1 else (columns * 3.4, rows * 3.0)
    canvas = Canvas(figsize=size, layout="constrained")
    FigureCanvasAgg(canvas)
    panels = list(np.ravel(canvas.subplots(rows, columns, squeeze=False)))
    if below:
        _draw_rows(panels, figure, frames[0])
    else:
        _draw_frames(panels, figure, frames)
    content = io.BytesIO()
    with rc_context({"svg.hashsalt": figure.name}):
        canvas.savefig(content, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(content.getvalue()).decode("ascii")


def _draw_frames(panels: "list[Axes]", figure: Figure, frames: Sequence[Frame]) -> None:
    for axes, frame in zip(panels, frames, strict=False):
        _draw(axes, figure, figure.y, frame)
        if len(figure.frames) > 1:
            axes.set_title(_plain(frame.label, LONGEST_UPRIGHT), fontsize="medium")
    for unused in panels[len(frames) :]:
        unused.set_visible(False)


def _draw_rows(panels: "list[Axes]", figure: Figure, frame: Frame) -> None:
    for row, (axes, axis) in enumerate(zip(panels, (figure.y, *figure.below), strict=True)):
        own = tuple(series for series in frame.series if series.row == row)
        _draw(axes, figure, axis, replace(frame, series=own))
    panels[0].set_title(_plain(frame.label, 2 * LONGEST_TEXT), fontsize="medium")


def _draw(axes: "Axes", figure: Figure, vertical: Axis, frame: Frame) -> None:
    if frame.cells is not None:
        _draw_cells(axes, figure, frame.cells)
    bars = sum(series.bars for series in frame.series)
    place = 0
    for series in frame.series:
        if series.bars:
            _draw_bars(axes, series, place, bars)
            place += 1
        else:
            _draw_line(axes, series)
    if any(series.name for series in frame.series):
        axes.legend(fontsize="x-small").set_in_layout(False)
    _set_axis(axes, figure.x, "x")
    _set_axis(axes, vertical, "y")
    axes.grid(alpha=0.3)
    if figure.is_square:
        axes.set_aspect("equal", adjustable="box")


def _draw_line(axes: "Axes", series: Series) -> None:
    axes.plot(
        series.places,
        series.y,
        linestyle=STYLES[series.line],
        marker="o" if series.markers else "",
        markersize=3,
        color=COLORS[series.color % len(COLORS)],
        alpha=series.opacity,
        linewidth=series.width * 0.75,
        label=_plain(series.name, LONGEST_UPRIGHT) or "_",
    )


def _draw_bars(axes: "Axes", series: Series, place: int, count: int) -> None:
    gaps = np.diff(series.places)
    width = 0.9 * (float(gaps.min()) if gaps.size else 1.0) / count
    left = np.asarray(series.places) + (place - (count - 1) / 2) * width
    color = COLORS[series.color % len(COLORS)]
    axes.bar(left, series.y, width, color=color, label=_plain(series.name, LONGEST_UPRIGHT) or "_")


def _draw_cells(axes: "Axes", figure: Figure, cells: Cells) -> None:
    from matplotlib.colors import LogNorm, Normalize

    values = np.ma.masked_invalid(np.asarray(cells.z, dtype=np.float64))
    norm = Normalize(cells.low, cells.high)
    if cells.is_count:
        values = np.ma.masked_equal(values, 0.0)
        norm = LogNorm(1.0, max(2.0, float(values.max() if values.count() else 2.0)))
    rows, columns = values.shape
    x, y = (
        np.linspace(axis.low, axis.high, count + 1)
        if axis.low is not None and axis.high is not None
        else np.arange(count + 1) - 0.5
        for axis, count in ((figure.x, columns), (figure.y, rows))
    )
    mesh = axes.pcolormesh(x, y, values, norm=norm, cmap="viridis", rasterized=True)
    axes.figure.colorbar(mesh, ax=axes, label=_plain(cells.unit, LONGEST_UPRIGHT))


def _set_axis(axes: "Axes", axis: Axis, name: str) -> None:
    place = axes.xaxis if name == "x" else axes.yaxis
    place.set_label_text(_plain(axis.label, LONGEST_TEXT if name == "x" else LONGEST_UPRIGHT))
    if axis.is_log:
        (axes.set_xscale if name == "x" else axes.set_yscale)("log", nonpositive="mask")
    if axis.low is not None and axis.high is not None:
        (axes.set_xlim if name == "x" else axes.set_ylim)(axis.low, axis.high)
    if axis.ticks is not None:
        place.set_ticks(list(axis.ticks), [_plain(text, LONGEST_TICK) for text in axis.ticks.values()])


def _plain(text: str, longest: int = LONGEST_TEXT) -> str:
    """A text that fits the picture, in which matplotlib finds no formula, and no mark of a hidden entry."""
    short = text if len(text) <= longest else f"{text[:longest]}…"
    return short.replace("$", r"\$").lstrip("_")
