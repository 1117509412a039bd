"""What the measures of `tcmrl-data inspect` share: progress, pictures, JSON, and cells of tables."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import click

from .frame import print_json, remark, stopped_by_signals, typed_command
from .progress import PartsProgress, StageProgress

if TYPE_CHECKING:
    from tcmrl_data.quality.measured import Measured

Found = TypeVar("Found", bound="Measured")
Report = Callable[[str], PartsProgress]
"""Takes the name of a stage and gives what reports its progress."""

UNITS = {"reading": "parts", "playing": "episodes"}

plot_option = click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Also draw a picture: a .png, .svg or .pdf file.",
)


class Stage(Protocol):
    """A row of a measure by step and split."""

    @property
    def step(self) -> int: ...
    @property
    def split(self) -> str: ...


@dataclass(frozen=True)
class MeasureOptions:
    """The options that all measures take."""

    as_json: bool
    quiet: bool
    plot: Path | None


def run_measure(
    options: MeasureOptions,
    measure: Callable[[Report], Found],
    show: Callable[[Found], None],
    draw: Callable[[Found, Path], None],
) -> None:
    """Measures with progress, draws the picture if one is wanted, and prints JSON or a table.

    Args:
        options: what was typed.
        measure: does the work.
        show: prints a table.
        draw: draws a picture to a file.
    """
    from tcmrl_data.quality.measured import check_picture

    if options.plot is not None:
        check_picture(options.plot)
    with stopped_by_signals(lambda: f"nothing was written; run `{typed_command()}` again"):
        with StageProgress(quiet=options.quiet) as progress:

            def report(stage: str) -> PartsProgress:
                return lambda done, total: progress.update(stage, done=done, total=total, unit=UNITS[stage])

            found = measure(report)
        if options.plot is not None:
            draw(found, options.plot)
            remark(f"picture written to {options.plot}", quiet=options.quiet)
        if options.as_json:
            print_json(found.model_dump(mode="json"))
        else:
            show(found)


def title(found: "Measured") -> str:
    """What tables call the dataset."""
    return found.label or found.environment


def stage_cells(previous: Stage | None, stage: Stage) -> tuple[str, str]:
    """Step and split of a row; a step that the row before has too is left out."""
    is_repeated = previous is not None and previous.step == stage.step
    return "" if is_repeated else f"{stage.step:,}", stage.split
