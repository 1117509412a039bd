"""Pictures of `--plot`: figures without a window, in three formats."""

from pathlib import Path
from typing import TYPE_CHECKING

from tcmrl_data.foundation.errors import SelectionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLOT_FORMATS = (".pdf", ".png", ".svg")
DOTS_PER_INCH = 130


def check_picture(file: Path) -> None:
    """Checks the name of a picture before the work that it shows.

    Raises:
        SelectionError: the ending names no supported format, or the folder does not exist.
    """
    if file.suffix.lower() not in PLOT_FORMATS:
        raise SelectionError(f"--plot {file}: the name must end in {', '.join(PLOT_FORMATS)}")
    if not file.parent.is_dir():
        raise SelectionError(f"--plot {file}: {file.parent} is not a folder; make it first")


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of so many inches, which opens no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", file: Path) -> None:
    """Writes a figure; the ending of the name is its format.

    Raises:
        SelectionError: as `check_picture` does.
    """
    check_picture(file)
    figure.savefig(file, dpi=DOTS_PER_INCH)
