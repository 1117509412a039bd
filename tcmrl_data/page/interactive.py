"""Figures as JSON for plotly.js, which the extra `report` brings; the page's script draws them."""

import base64
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from tcmrl_data.page.figures import COLORS, Axis, Cells, Figure, Frame, Series, Values
from tcmrl_data.page.markup import escape

CODES = {"float32": "f4", "float64": "f8", "uint8": "u1", "uint16": "u2", "uint32": "u4", "int32": "i4"}
"""plotly.js's names of the kinds of numbers that it reads from base64."""


@functools.cache
def plotly_script() -> str | None:
    """The source of plotly.js; None where plotly is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        return None
    return str(get_plotlyjs())


def figure_document(figure: Figure) -> dict[str, Any]:
    """The JSON document of a figure: the layout, and the label and the traces of each frame."""
    return {"layout": _layout(figure), "frames": [_frame(figure, frame) for frame in figure.frames]}


def _frame(figure: Figure, frame: Frame) -> dict[str, Any]:
    cells = [] if frame.cells is None else [_heat_map(figure, frame.cells)]
    return {"label": frame.label, "traces": cells + [_trace(series) for series in frame.series]}


def _trace(series: Series) -> dict[str, Any]:
    color = COLORS[series.color % len(COLORS)]
    trace: dict[str, Any] = {
        "y": _numbers(series.y),
        "name": _text(series.name),
        "showlegend": bool(series.name),
        "opacity": series.opacity,
        "hovertemplate": "%{x}: %{y:.4g}<extra>" + _hover(series.label or series.name) + "</extra>",
    }
    if series.x is not None:
        trace["x"] = _numbers(series.x)
    if series.row:
        trace["yaxis"] = f"y{series.row + 1}"
    if series.group:
        trace["legendgroup"] = _text(series.group)
    if series.bars:
        return trace | {"type": "bar", "marker": {"color": color}}
    line = {"color": color, "width": series.width, "dash": series.line}
    modes = ["lines"] * (series.line != "none") + ["markers"] * series.markers
    if series.line == "none":
        line = {}
    return trace | {
        "type": "scatter",
        "mode": "+".join(modes),
        "line": line,
        "marker": {"color": color, "size": 6},
    }


def _heat_map(figure: Figure, cells: Cells) -> dict[str, Any]:
    rows, columns = cells.z.shape
    trace: dict[str, Any] = {
        "type": "heatmap",
        "z": _numbers(cells.z),
        "colorscale": "Viridis",
        "hoverongaps": False,
        "colorbar": {"title": {"text": _text(cells.unit), "side": "right"}, "thickness": 14},
        "zmin": cells.low,
        "zmax": cells.high,
    }
    trace |= _places("x", figure.x, columns) | _places("y", figure.y, rows)
    return trace | ({"isCount": True} if cells.is_count else {})


def _places(name: str, axis: Axis, count: int) -> dict[str, float]:
    """Where the cells of a heat map lie along an axis; at 0, 1, … where the axis has no range."""
    if axis.low is None or axis.high is None:
        return {}
    width = (axis.high - axis.low) / count
    return {f"{name}0": axis.low + width / 2, f"d{name}": width}


def _layout(figure: Figure) -> dict[str, Any]:
    has_cells = any(frame.cells is not None for frame in figure.frames)
    x, y = _axis(figure.x), _axis(figure.y)
    if figure.below:
        x["anchor"] = f"y{len(figure.below) + 1}"
    if figure.is_square:
        y |= {"scaleanchor": "x", "scaleratio": 1, "constrain": "domain"}
        x |= {"constrain": "domain"}
    return {
        "height": figure.height,
        "margin": {"l": 64, "r": 16, "t": 16, "b": 56},
        "xaxis": x,
        **_vertical_axes(y, figure.below),
        "barmode": "group",
        "hovermode": "closest",
        "showlegend": any(series.name for frame in figure.frames for series in frame.series),
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "font": {"size": 12}},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff" if has_cells else "#fafafa",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#222222"},
    }


def _vertical_axes(first: dict[str, Any], below: Sequence[Axis]) -> dict[str, dict[str, Any]]:
    """The vertical axes from top to bottom; the horizontal axis stands under the last."""
    axes = [first, *map(_axis, below)]
    height = 1.0 / len(axes)
    for place, axis in enumerate(axes):
        top = 1.0 - place * height
        axis["domain"] = [top - height * (0.88 if place + 1 < len(axes) else 1.0), top]
    return {f"yaxis{place + 1 if place else ''}": axis for place, axis in enumerate(axes)}


def _axis(axis: Axis) -> dict[str, Any]:
    document: dict[str, Any] = {
        "title": {"text": _text(axis.label)},
        "automargin": True,
        "gridcolor": "#e2e2e2",
        "zeroline": False,
    }
    if axis.is_log:
        document |= {"type": "log", "dtick": 1}
    if axis.low is not None and axis.high is not None:
        document["range"] = [axis.low, axis.high]
    if axis.ticks is not None:
        document |= {"tickvals": list(axis.ticks), "ticktext": [_text(text) for text in axis.ticks.values()]}
    return document


def _numbers(values: Values) -> dict[str, Any]:
    """An array as plotly.js reads it from base64; integers of 64 bits become doubles."""
    array = np.ascontiguousarray(values)
    if array.dtype.name not in CODES:
        array = array.astype(np.float64)
    array = array.astype(array.dtype.newbyteorder("<"))
    document = {"dtype": CODES[array.dtype.name], "bdata": base64.b64encode(array.tobytes()).decode("ascii")}
    return document if array.ndim == 1 else document | {"shape": ", ".join(map(str, array.shape))}


def _text(text: str) -> str:
    """A text in which plotly.js finds no tag of its own; it reads some tags in every text."""
    return escape(text)


def _hover(text: str) -> str:
    """A text within a template of plotly.js, which replaces what stands in braces behind a percent sign."""
    return _text(text).replace("%{", "%&#123;")
