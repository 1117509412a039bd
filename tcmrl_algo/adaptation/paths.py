"""A picture of the paths that an adapted policy takes in the test tasks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_data import Dataset, Environment, RenderingError, Trajectory

PLOT_FORMATS = (".pdf", ".png", ".svg")
PANEL = 4.0
"""Width of a panel in inches."""


@dataclass(frozen=True)
class FinalEpisodes:
    """The final episodes of an evaluation, by index of the test task.

    Attributes:
        adapted: with the task's own contexts.
        other: with contexts of other tasks.
    """

    adapted: Mapping[int, Sequence[Trajectory]]
    other: Mapping[int, Sequence[Trajectory]]


@final
class PathPlot:
    """Draws a final episode of every test task, and beside it one under another task's context.

    Args:
        file: picture to write.
        dataset: with environment and tasks.
        settings: of the evaluation, for the titles.

    Raises:
        RenderingError: the environment's paths cannot be drawn, or the file's ending is not known.
    """

    def __init__(self, file: Path, dataset: Dataset, settings: RunSettings) -> None:
        if file.suffix.lower() not in PLOT_FORMATS:
            raise RenderingError(f"--plot {file}: the name must end in {', '.join(PLOT_FORMATS)}")
        if type(dataset.environment).draw_path is Environment.draw_path:
            raise RenderingError(
                f"--plot {file}: {dataset.environment.name} has no paths in a plane to draw; leave --plot out"
            )
        self._file, self._dataset, self._settings = file, dataset, settings

    def __call__(self, episodes: FinalEpisodes) -> None:
        """Writes the picture."""
        from matplotlib import colormaps
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.colors import to_hex
        from matplotlib.figure import Figure

        figure = Figure(figsize=(2 * PANEL, 0.62 * PANEL), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        name = self._settings.algorithm
        titles = (f"{name}, adapted ({self._settings.protocol})", f"{name}, other tasks' contexts")
        colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(episodes.adapted)))
        for axes, title, found in zip(panels, titles, (episodes.adapted, episodes.other), strict=True):
            for place, (index, trajectories) in enumerate(found.items()):
                color, parameters = colors[place], self._dataset.task(index).parameters
                # contexts of several other tasks take turns
                observations = trajectories[place % len(trajectories)].observations
                self._dataset.environment.draw_path(axes, parameters, observations, color=to_hex(color))
            axes.set(title=title, xlabel="x")
        panels[0].set_ylabel("y")
        figure.suptitle(f"{self._dataset.name}: paths in {len(episodes.adapted)} test tasks")
        figure.savefig(self._file, dpi=110)
