"""Figures of a dataset's report, one per function, drawn by plotly.js."""

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from plotly.graph_objects import Bar, Figure, Heatmap, Scatter

from tcmrl_data.dataset.listing import SPLITS, summarize_returns
from tcmrl_data.describe.measures import ACTION_BINS, BROWSED_COLUMNS, Browsed, Content
from tcmrl_data.foundation.page import escaped
from tcmrl_data.foundation.seeding import evenly_spread
from tcmrl_data.quality.measured import STEPS_LABEL, TICKS
from tcmrl_data.quality.transfer import Transfer
from tcmrl_data.store.tables import MAIN_RUN, PartKey

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#444444", "#8C6D1F")
"""Okabe and Ito's palette, which the color-blind can tell apart, without its light yellow."""

GRAY = 6
"""Index of the palette's dark gray, for references."""

Values = npt.NDArray[Any]
Axis = dict[str, Any]
SliderFrame = tuple[str, Sequence[Any]]
"""A place of a slider in words, and the traces of plotly that are shown there."""


@dataclass(frozen=True)
class ReportFigure:
    """A figure with a slider over its frames, if it has several.

    Attributes:
        caption: what the reader sees, in a sentence or two.
        slider: what the slider goes through, such as `task`; it starts at the last frame where `starts_last`.
    """

    name: str
    caption: str
    layout: dict[str, Any]
    frames: Sequence[SliderFrame]
    slider: str = ""
    starts_last: bool = False

    @property
    def labels(self) -> list[str]:
        """Of the frames."""
        return [label for label, _ in self.frames]

    @property
    def start(self) -> int:
        """Place of the slider at first."""
        return len(self.frames) - 1 if self.starts_last else 0

    @property
    def document(self) -> Markup:
        """JSON for the page's script: the layout, and the label and the traces of each frame."""
        layout = json.loads(Figure(layout=self.layout).to_json())["layout"]
        frames = [
            {"label": label, "traces": json.loads(Figure(traces).to_json())["data"]}
            for label, traces in self.frames
        ]
        document = json.dumps({"layout": layout, "frames": frames}, allow_nan=False, separators=(",", ":"))
        # `</script>` in a text would end the element; in JSON these characters stand in strings only.
        return Markup(document.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def learning_curves(content: Content) -> ReportFigure:
    """Mean return by snapshot, a thin line per task and run, with means over the tasks of a split."""
    shown = {task.index for task in content.shown}
    lines: list[Any] = []
    for color, split in enumerate(SPLITS):
        tasks = [row for row in content.returns["tasks"] if row["split"] == split and row["task"] in shown]
        for place, task in enumerate(tasks):
            lines += _task_curves(task, color, is_first=place == 0)
    for color, split in enumerate(SPLITS):
        rows = [row for row in summarize_returns(content.returns) if row["split"] == split]
        if rows:
            x, y = (np.array([row[name] for row in rows]) for name in ("step", "mean"))
            lines.append(_line(x, y, f"mean of {split} tasks", color=color, width=3.5, markers=True))
    steps = content.summary["snapshots"]
    lines += _references(content, steps[0], steps[-1])
    caption = (
        "A thin line is a task. Click on an entry of the legend to hide its lines, and again to show them; "
        "point at a line to see which task it is."
    )
    layout = _layout(_axis(STEPS_LABEL), _axis("mean undiscounted return"), height=460)
    return ReportFigure("learning-curves", caption, layout, [("", lines)])


def _task_curves(task: dict[str, Any], color: int, *, is_first: bool) -> Iterator[Any]:
    runs = list(dict.fromkeys(found["run"] for found in task["snapshots"]))
    for run in runs:
        own = [found for found in task["snapshots"] if found["run"] == run]
        x, y = (np.array([found[name] for found in own]) for name in ("step", "mean"))
        yield _line(
            x,
            y,
            f"{task['split']} tasks" if is_first and run == runs[0] else "",
            group=task["split"],
            label=f"task {task['task']} ({task['split']}){_of_run(run)}",
            color=color,
            width=1.0,
            opacity=0.45,
            markers=len(own) == 1,
        )


def _references(content: Content, low: float, high: float) -> Iterator[Any]:
    """Lines at the means of the reference returns over all tasks that have them."""
    for name, dash in {"oracle": "dash", "scripted": "dash", "uniform": "dot"}.items():
        known = [task["references"][name] for task in content.tasks["tasks"] if task["references"]]
        if known and None not in known:
            ends = np.array([low, max(high, low + 1)]), np.full(2, np.mean(known))
            yield _line(*ends, f"{name}, mean of all tasks", color=GRAY, dash=dash)


def returns_by_snapshot(content: Content) -> ReportFigure:
    """How the returns of episodes are distributed, snapshot by snapshot."""
    edges = content.endings.edges
    frames = [
        (f"step {step:,} ({found.episodes:,} episodes)", [_bars(edges, found.returns / found.episodes)])
        for step, found in sorted(content.endings.by_step.items())
    ]
    top = max(float((found.returns / found.episodes).max()) for found in content.endings.by_step.values())
    x = _axis("undiscounted return of an episode", edges[0], edges[-1])
    layout = _layout(x, _axis("share of episodes", 0.0, 1.05 * top), height=320)
    caption = "All tasks together; the scale stays the same from step to step."
    return ReportFigure("returns", caption, layout, frames, "snapshot", starts_last=True)


def state_visits(content: Content) -> ReportFigure:
    """Where the episodes of a task went, as a heat map of the plane."""
    visits, plane = content.visits, content.plane
    frames = []
    for task in content.shown:
        counts = visits.counts[task.index]
        smallest = counts.astype(np.min_scalar_type(int(counts.max())))  # most of a report is these cells
        cells = _heat_map(
            smallest, "visits", x=(plane.low[0], plane.high[0]), y=(plane.low[1], plane.high[1])
        )
        cells.meta = "counts"  # the page's script colors them by their logarithm
        frames.append((f"task {task.index} ({task.split})", [cells]))
    caption = (
        "Number of stored states in each cell, all snapshots of the task together; white was never visited."
    )
    if visits.outside / visits.total >= 5e-5:
        caption += f" {visits.outside / visits.total:.2%} of the states lie outside the picture."
    return ReportFigure("visits", caption + _plane_note(content), _plane_layout(content), frames, "task")


def trajectories(content: Content) -> ReportFigure:
    """Paths of the first episodes of the first, the middle and the last snapshot of a task."""
    frames = []
    for task in content.shown:
        keys = [key for key in content.paths.found if key.task == task.index]
        keys.sort(key=lambda key: (key.step, key.run))
        lines = [_path(content, key, place) for place, key in enumerate(keys)]
        frames.append((f"task {task.index} ({task.split})", lines))
    caption = "The first three episodes of the first, the middle and the last snapshot."
    return ReportFigure(
        "trajectories", caption + _plane_note(content), _plane_layout(content), frames, "task"
    )


def _path(content: Content, key: PartKey, place: int) -> Any:
    points = content.paths.found[key]
    name = f"step {key.step:,}{_of_run(key.run)}"
    return _line(points[:, 0], points[:, 1], name, color=(GRAY, 5, 0)[place % 3], width=1.5, opacity=0.8)


def _plane_layout(content: Content) -> dict[str, Any]:
    """Places in the plane have one unit along both axes; principal components do not."""
    plane = content.plane
    x, y = (_axis(plane.names[axis], plane.low[axis], plane.high[axis]) for axis in (0, 1))
    return _layout(x, y, height=480, is_square=plane.explained is None)


def _plane_note(content: Content) -> str:
    if content.plane.explained is None:
        return ""
    return (
        " The plane is that of the first two principal components of the standardized observations, "
        f"which keep {content.plane.explained:.0%} of their variance."
    )


def action_histograms(content: Content) -> ReportFigure:
    """How actions are distributed, a line per column, snapshot by snapshot."""
    middles = (np.arange(ACTION_BINS) + 0.5) * (2 / ACTION_BINS) - 1
    frames, top = [], 0.0
    for step, counts in sorted(content.actions.counts.items()):
        shares = (counts / np.maximum(counts.sum(axis=1, keepdims=True), 1))[:BROWSED_COLUMNS]
        lines = [_line(middles, row, f"action {column}", color=column) for column, row in enumerate(shares)]
        frames.append((f"step {step:,}", lines))
        top = max(top, float(shares.max()))
    caption = (
        f"Share of the values of each column in {ACTION_BINS} bins; peaks at −1 and 1 are saturated actions."
    )
    y = _axis("share of values", 0.0, 1.05 * top)
    layout = _layout(_axis("action", -1.0, 1.0), y, height=340)
    return ReportFigure("actions", caption, layout, frames, "snapshot", starts_last=True)


def episode_browser(content: Content) -> ReportFigure:
    """Whole episodes: rewards, actions and observations over time."""
    frames = [(_browsed_label(found), list(_browsed_lines(found))) for found in content.browsed]
    drawn = [
        "all columns" if count <= BROWSED_COLUMNS else f"the first {BROWSED_COLUMNS} of {count} columns"
        for count in content.browsed[0].columns
    ]
    caption = (
        f"Of the observations {drawn[0]} are drawn, of the actions {drawn[1]}. "
        "The same episodes are stored in the parts that the slider names."
    )
    rows = _axis("reward"), _axis("action", -1.05, 1.05), _axis("observation")
    layout = _layout(_axis("step of the episode"), *rows, height=620)
    return ReportFigure("episodes", caption, layout, frames, "episode", starts_last=True)


def _browsed_label(found: Browsed) -> str:
    key = found.key
    return (
        f"task {key.task}, step {key.step:,}{_of_run(key.run)}, episode {found.number}: "
        f"return {found.total:.4g}, {found.length:,} steps, {found.ended}"
    )


def _browsed_lines(found: Browsed) -> Iterator[Any]:
    markers = len(found.rewards) <= 50
    yield _line(found.steps, found.rewards, label="reward", color=GRAY, markers=markers)
    for row, name, values in ((1, "action", found.actions), (2, "observation", found.observations)):
        for column, y in enumerate(values.T):
            yield _line(found.steps, y, label=f"{name} {column}", color=column, width=1.5, row=row)


def scores(content: Content) -> ReportFigure:
    """Trajectory quality of every shown task at every snapshot."""
    shown = {task.index for task in content.shown}
    rows = [task for task in content.quality.tasks if task.task in shown]
    steps = sorted({snapshot.step for task in rows for snapshot in task.snapshots})
    cells = np.full((len(rows), len(steps)), np.nan, np.float32)
    for row, task in enumerate(rows):
        for snapshot in reversed(task.snapshots):  # of several runs, the first is shown
            if snapshot.tq is not None:
                cells[row, steps.index(snapshot.step)] = snapshot.tq
    caption = (
        "Trajectory quality (TQ): 0 is the return of uniform actions, 1 the best that is known of the task. "
        "A row is a task, from bottom to top in the order of their indices."
    )
    x, y = (
        _axis(STEPS_LABEL, ticks=[f"{step:,}" for step in steps]),
        _axis("task", ticks=[row.task for row in rows]),
    )
    frame = ("", [_heat_map(cells, "TQ", low=0.0, high=1.0)])
    return ReportFigure("scores", caption, _layout(x, y, height=460), [frame])


def coverage(content: Content) -> ReportFigure:
    """Coverage of state-action cells beside trajectory quality, by snapshot."""
    found = content.coverage
    caption = (
        f"Coverage (SACo): different state-action cells of a part, {found.cell:g} standard deviations wide "
        f"in {found.columns} columns, as a share of those of all parts of its task; beside the trajectory "
        "quality. Means over tasks."
    )
    lines = _stage_lines(found.stages, saco="coverage", tq="TQ")
    return ReportFigure(
        "coverage", caption, _layout(_axis(STEPS_LABEL), _axis("share"), height=360), [("", lines)]
    )


def silence(content: Content) -> ReportFigure:
    """Share of zero rewards and of episodes without any reward, by snapshot."""
    caption = "A task whose rewards are all zero cannot be told from others by its rewards. Means over parts."
    lines = _stage_lines(content.rewards.stages, zero="zero rewards", silent="episodes without reward")
    layout = _layout(_axis(STEPS_LABEL), _axis("share", -0.03, 1.03), height=340)
    return ReportFigure("silence", caption, layout, [("", lines)])


def _stage_lines(stages: Sequence[Any], **measures: str) -> list[Any]:
    lines = []
    for color, split in enumerate(SPLITS):
        own = [stage for stage in stages if stage.split == split]
        x = np.array([stage.step for stage in own])
        for (field, words), dash in zip(measures.items(), ("solid", "dot"), strict=True):
            y = np.array([getattr(stage, field) for stage in own], np.float64)  # None becomes NaN
            if own:
                lines.append(_line(x, y, f"{words}, {split} tasks", color=color, dash=dash, markers=True))
    return lines


def overlap(content: Content) -> ReportFigure:
    """How far tasks visit the same states."""
    found = content.coverage.overlap
    caption = (
        "Row i, column j: share of the state cells of task i that task j visits too. Where tasks share most "
        "of their states, rewards must tell them apart."
    )
    x, y = (_axis(f"task {name}", ticks=found.tasks) for name in "ji")
    cells = _heat_map(np.array(found.shares, np.float32), "share of cells", low=0.0, high=1.0)
    return ReportFigure("overlap", caption, _layout(x, y, height=460, is_square=True), [("", [cells])])


def transfer(found: Transfer) -> ReportFigure:
    """What the last policy of every task scores in every task."""
    names = [task.task for task in found.tasks]
    is_scored = all(value is not None for row in found.scores for value in row)
    what = "score, where uniform actions have 0 and the best known return 1," if is_scored else "mean return"
    caption = (
        f"Row i, column j: {what} of the last policy of task i in task j; {found.episodes} episodes each, "
        "training tasks first. A single policy that is good everywhere is a bright row."
    )
    values = np.array(found.scores if is_scored else found.returns, np.float32)
    low, high = (0.0, 1.0) if is_scored else (float(values.min()), float(values.max()))
    cells = _heat_map(values, "score" if is_scored else "return", low=low, high=high)
    x, y = _axis("task j", ticks=names), _axis("policy of task i", ticks=names)
    return ReportFigure("transfer", caption, _layout(x, y, height=460, is_square=True), [("", [cells])])


def rewards(content: Content) -> ReportFigure:
    """How rewards are distributed, snapshot by snapshot."""
    edges = np.array(content.rewards.edges)
    stages = sorted(content.rewards.stages, key=lambda stage: stage.step)
    frames = []
    for step, found in itertools.groupby(stages, key=lambda stage: stage.step):
        bars = [
            _bars(
                edges,
                np.array(stage.counts) / max(1, sum(stage.counts)),
                f"{stage.split} tasks",
                color=SPLITS.index(stage.split),
            )
            for stage in found
        ]
        frames.append((f"step {step:,}", bars))
    caption = "The outermost bars also count what lies beyond them. The vertical axis is logarithmic."
    y = _axis("share of rewards") | {"type": "log", "dtick": 1}
    layout = _layout(_axis("reward", edges[0], edges[-1]), y, height=340)
    return ReportFigure("rewards", caption, layout, frames, "snapshot", starts_last=True)


def _of_run(run: str) -> str:
    return "" if run == MAIN_RUN else f", {run}"


def _line(
    x: Values,
    y: Values,
    name: str = "",
    *,
    group: str | None = None,
    label: str = "",
    color: int = 0,
    dash: str = "solid",
    markers: bool = False,
    width: float = 2.0,
    opacity: float = 1.0,
    row: int = 0,
) -> Any:
    """Connected points; NaN interrupts a line, `label` is what a reader sees who points at it."""
    return Scatter(
        x=x,
        y=y,
        mode="lines+markers" if markers else "lines",
        line={"color": COLORS[color % len(COLORS)], "width": width, "dash": dash},
        marker={"color": COLORS[color % len(COLORS)], "size": 6},
        opacity=opacity,
        legendgroup=group,
        yaxis=f"y{row + 1}" if row else None,
        **_names(name, label or name),
    )


def _bars(edges: Values, heights: Values, name: str = "", *, color: int = 0) -> Any:
    middles = (edges[1:] + edges[:-1]) / 2
    return Bar(x=middles, y=heights, marker={"color": COLORS[color % len(COLORS)]}, **_names(name, name))


def _names(name: str, label: str) -> dict[str, Any]:
    # plotly.js replaces what stands in braces behind a percent sign.
    hover = _text(label).replace("%{", "%&#123;")
    return {
        "name": _text(name),
        "showlegend": bool(name),
        "hovertemplate": f"%{{x}}: %{{y:.4g}}<extra>{hover}</extra>",
    }


def _heat_map(
    z: Values,
    unit: str,
    *,
    x: tuple[float, float] | None = None,
    y: tuple[float, float] | None = None,
    low: float | None = None,
    high: float | None = None,
) -> Any:
    """Cells, the first row at the bottom; NaN is blank.

    Args:
        x: borders of what the columns divide; their centers are at 0, 1, … where None.
    """
    places: dict[str, float] = {}
    for name, borders, count in (("x", x, z.shape[1]), ("y", y, z.shape[0])):
        if borders is not None:
            width = (borders[1] - borders[0]) / count
            places |= {f"{name}0": borders[0] + width / 2, f"d{name}": width}
    return Heatmap(
        z=z,
        colorscale="Viridis",
        hoverongaps=False,
        colorbar={"title": {"text": _text(unit), "side": "right"}, "thickness": 14},
        zmin=low,
        zmax=high,
        **places,
    )


def _axis(
    label: str, low: float | None = None, high: float | None = None, *, ticks: Sequence[Any] | None = None
) -> Axis:
    """An axis; of the names `ticks` of rows or columns 0, 1, … at most TICKS are written."""
    axis: Axis = {
        "title": {"text": _text(label)},
        "automargin": True,
        "gridcolor": "#e2e2e2",
        "zeroline": False,
    }
    if low is not None and high is not None:
        axis["range"] = [float(low), float(high)]
    if ticks is not None:
        places = evenly_spread(range(len(ticks)), TICKS)
        axis |= {"tickvals": places, "ticktext": [_text(str(ticks[place])) for place in places]}
    return axis


def _layout(x: Axis, *y: Axis, height: int, is_square: bool = False) -> dict[str, Any]:
    """A layout whose vertical axes stand below each other over one horizontal axis."""
    share = 1.0 / len(y)
    for place, axis in enumerate(y):
        top = 1.0 - place * share
        axis["domain"] = [top - share * (0.88 if place + 1 < len(y) else 1.0), top]
    if len(y) > 1:
        x["anchor"] = f"y{len(y)}"
    if is_square:
        x["constrain"] = "domain"
        y[0].update(scaleanchor="x", scaleratio=1, constrain="domain")
    return {
        "template": "none",
        "height": height,
        "margin": {"l": 64, "r": 16, "t": 16, "b": 56},
        "xaxis": x,
        **{f"yaxis{place + 1 if place else ''}": axis for place, axis in enumerate(y)},
        "barmode": "group",
        "hovermode": "closest",
        "showlegend": True,
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "font": {"size": 12}},
        "plot_bgcolor": "#ffffff",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#222222"},
    }


def _text(text: str) -> str:
    """A text in which plotly.js, which reads some tags in every text, finds none of its own."""
    return str(escaped(text))
