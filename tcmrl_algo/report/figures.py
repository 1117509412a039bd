"""Figures of a report, drawn to PNG files without a display."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.report.contexts import FloatArray, IntArray, TransitionWeights
from tcmrl_algo.report.statistics import by_method, mean_interval, summarize

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 4.6, 3.6
"""Size of one panel in inches."""


def draw_curves(file: Path, title: str, results: Sequence[RunResult], protocol: str) -> None:
    """Mean returns of the test tasks during training; intervals from five seeds on, else a line per seed."""
    figure, (axes,) = _panels(1, width=1.5 * WIDTH)
    for index, (method, runs) in enumerate(by_method(results).items()):
        steps = [point.step for point in runs[0].curve]
        _draw_curve(axes, index, method, steps, [[point.final for point in run.curve] for run in runs])
    _draw_references(axes, results[0])
    axes.set(xlabel="training steps", ylabel=f"return on test tasks ({protocol})", title=title)
    axes.legend(fontsize="small")
    figure.savefig(file, dpi=130)


def draw_method_curves(
    file: Path, title: str, curves: Mapping[str, Mapping[int, Sequence[float]]], protocol: str
) -> None:
    """The same of returns by method and step, one per run."""
    figure, (axes,) = _panels(1, width=1.5 * WIDTH)
    for index, (method, points) in enumerate(curves.items()):
        runs = [list(run) for run in zip(*points.values(), strict=True)]
        _draw_curve(axes, index, method, list(points), runs)
    axes.set(xlabel="training steps", ylabel=f"return on test tasks ({protocol})", title=title)
    axes.legend(fontsize="small")
    figure.savefig(file, dpi=100)


def _draw_curve(
    axes: "Axes", index: int, label: str, steps: Sequence[int], runs: Sequence[Sequence[float]]
) -> None:
    color, style = f"C{index % 10}", "o-" if index < 10 else "s--"  # there are ten colors
    points = [summarize(values) for values in zip(*runs, strict=True)]
    axes.plot(steps, [point.mean for point in points], style, color=color, label=label, markersize=3)
    lows, highs = [point.low for point in points], [point.high for point in points]
    if None not in lows:
        axes.fill_between(steps, lows, highs, color=color, alpha=0.2, linewidth=0)  # type: ignore[arg-type]
    else:
        for run in runs:
            axes.plot(steps, run, color=color, alpha=0.4, linewidth=0.8)


def draw_finals(file: Path, title: str, results: Sequence[RunResult]) -> None:
    """Final returns per protocol: a line at the mean, a dot per seed, and an interval from five seeds on."""
    protocols = list(results[0].evaluations)
    figure, panels = _panels(len(protocols))
    methods = by_method(results)
    for axes, protocol in zip(panels, protocols, strict=True):
        for place, runs in enumerate(methods.values()):
            summary = summarize([run.evaluations[protocol]["mean_final"] for run in runs])
            color = f"C{place % 10}"
            axes.hlines(summary.mean, place - 0.3, place + 0.3, color=color, linewidth=3)
            axes.plot([place] * len(runs), summary.values, ".", color="0.3", markersize=5)
            if summary.low is not None and summary.high is not None:
                axes.vlines(place, summary.low, summary.high, color=color, linewidth=8, alpha=0.3)
        axes.set_xticks(range(len(methods)), list(methods), rotation=30, ha="right", fontsize="small")
        axes.set(title=f"{title}: {protocol}", ylabel="return", xlim=(-0.6, len(methods) - 0.4))
    figure.savefig(file, dpi=130)


def draw_board(file: Path, title: str, board: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    """Mean returns with intervals, a line per method and a color per protocol."""
    methods = list(dict.fromkeys(method for found in board.values() for method in found))[::-1]
    figure, (axes,) = _panels(1, width=1.5 * WIDTH, height=max(HEIGHT, 0.35 * len(methods) + 1.0))
    for index, (protocol, found) in enumerate(board.items()):
        color, shift = f"C{index % 10}", 0.6 * (0.5 - (index + 0.5) / len(board))
        for method, finals in found.items():
            place = methods.index(method) + shift
            low, high = mean_interval(finals, fewest=2) or (finals[0], finals[0])
            axes.plot(sum(finals) / len(finals), place, "o", color=color, markersize=4)
            axes.hlines(place, low, high, color=color, linewidth=1.2)
        axes.plot([], [], "o-", color=color, label=protocol, markersize=4)
    axes.set_yticks(range(len(methods)), methods, fontsize="small")
    axes.set_xlabel("return on test tasks")
    axes.set_title(title, fontsize="small")
    axes.legend(fontsize="x-small")
    figure.savefig(file, dpi=100)


def draw_adaptation(file: Path, title: str, results: Sequence[RunResult]) -> None:
    """Return of the first, second, … adaptation episode, means over tasks and runs; a panel per protocol."""
    protocols = list(results[0].evaluations)
    figure, panels = _panels(len(protocols))
    for axes, protocol in zip(panels, protocols, strict=True):
        for index, (method, runs) in enumerate(by_method(results).items()):
            curves = [run.evaluations[protocol].get("adaptation_curve", []) for run in runs]
            means = [float(np.mean(values)) for values in zip(*curves, strict=False)]
            axes.plot(range(1, len(means) + 1), means, ".-", color=f"C{index % 10}", label=method)
        axes.set(xlabel="episode", ylabel="return", title=f"{title}: {protocol}")
        axes.legend(fontsize="small")
    figure.savefig(file, dpi=130)


def draw_embeddings(
    file: Path,
    points: Mapping[str, FloatArray],
    labels: Mapping[str, IntArray],
    is_test: Sequence[bool],
) -> None:
    """t-SNE of contexts: a panel per method, a color per task, triangles for test tasks."""
    figure, panels = _panels(len(points))
    for axes, (method, places) in zip(panels, points.items(), strict=True):
        for task, test in enumerate(is_test):
            own = places[labels[method] == task]
            color = [_color(task, len(is_test))]
            axes.scatter(own[:, 0], own[:, 1], s=14, c=color, marker="^" if test else "o")
        axes.set(title=method, xticks=[], yticks=[])
    figure.savefig(file, dpi=130)


def draw_attention(file: Path, weights: Mapping[str, TransitionWeights]) -> None:
    """Relative attention by step: the mean over trajectories, and one trajectory with its rewards."""
    figure, panels = _panels(1 + len(weights))
    mean, *examples = panels
    for method, method_weights in weights.items():
        mean.plot(method_weights.by_step, label=method)
    mean.axhline(1.0, color="0.5", linestyle=":")
    mean.set(xlabel="step", ylabel="weight × steps (uniform: 1)", title="mean over trajectories")
    mean.legend(fontsize="small")
    for axes, (method, method_weights) in zip(examples, weights.items(), strict=True):
        axes.bar(range(len(method_weights.example)), method_weights.example, color="C0", alpha=0.6)
        axes.set(xlabel="step", ylabel="weight × steps", title=f"{method}: one trajectory")
        rewards = axes.twinx()
        rewards.plot(method_weights.example_rewards, "C1.-", markersize=3)
        rewards.set_ylabel("reward", color="C1")
    figure.savefig(file, dpi=130)


def _panels(count: int, *, width: float = WIDTH, height: float = HEIGHT) -> "tuple[Figure, list[Axes]]":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    FigureCanvasAgg(figure)
    grid = list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
    for unused in grid[count:]:
        unused.set_visible(False)
    for axes in grid:
        axes.grid(alpha=0.3)
    return figure, grid[:count]


def _draw_references(axes: "Axes", result: RunResult) -> None:
    """Lines of the oracle and of uniform actions; the latter only in the legend if far below the curves."""
    tasks = next(iter(result.evaluations.values()))["tasks"]
    low, high = axes.get_ylim()
    for name, label, line in (("oracle", "oracle", "--"), ("random", "uniform actions", ":")):
        values = [task[name] for task in tasks]
        if None in values:
            continue
        mean = float(np.mean(values))
        if name == "oracle":
            high = max(high, mean)
        elif low - mean > high - low:
            axes.plot([], [], color="0.3", linestyle=line, label=f"{label}: {mean:.1f}")
            continue
        axes.axhline(mean, color="0.3", linestyle=line, label=label)


def _color(index: int, count: int) -> tuple[float, float, float, float]:
    from matplotlib import colormaps

    red, green, blue, alpha = colormaps["turbo"](index / max(count - 1, 1))
    return float(red), float(green), float(blue), float(alpha)
