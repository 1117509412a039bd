"""`tcmrl-data report`: a page that shows what is in a dataset."""

from pathlib import Path

import click

from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable

from .frame import output_options, print_json, remark, stopped_by_signals
from .places import DATASET_PATH
from .progress import StageProgress

UNITS = {"reading": "parts", "playing": "episodes", "filming": "episodes"}
NOTHING_KEPT = "nothing was written; run the same command again"


@click.command(name="report")
@click.argument("dataset", type=DATASET_PATH)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    show_default="DATASET-report.html",
    help="The HTML file; an earlier one is replaced.",
)
@click.option(
    "--episodes",
    type=click.IntRange(1, 200),
    default=20,
    show_default=True,
    help="Number of whole episodes to browse.",
)
@click.option(
    "--transfer",
    is_flag=True,
    help="Let every last policy play in every task, and say what a context is worth; takes longer.",
)
@click.option(
    "--strips",
    type=click.IntRange(0, 20),
    default=0,
    show_default=True,
    help="Number of episodes to simulate again and draw; MuJoCo needs OpenGL.",
)
@output_options
def dataset_report(
    dataset: Path,
    out: Path | None,
    episodes: int,
    transfer: bool,
    strips: int,
    as_json: bool,
    quiet: bool,
) -> None:
    """Write a page that shows what is in DATASET.

    The page is one HTML file that needs no network: verdicts, learning curves, returns, states that the tasks
    visit, trajectories, actions, whole episodes, tasks and provenance. It prints on paper. Needs plotly:
    pip install 'tcmrl[report]'.

    \b
    Examples:
      tcmrl-data report data/point-robot
      tcmrl-data report data/point-robot --out report.html --episodes 40
      tcmrl-data report data/point-robot --transfer --strips 3
    """
    import tcmrl_data

    opened = tcmrl_data.open_dataset(dataset)
    place = opened.path if opened.path.name not in ("", "..") else opened.path.resolve()
    target = out or place.with_name(f"{place.stem if place.is_file() else place.name}-report.html")
    with stopped_by_signals(lambda: NOTHING_KEPT), StageProgress(quiet=quiet) as progress:
        tcmrl_data.report_dataset(
            opened,
            target,
            episodes=episodes,
            transfer=transfer,
            strips=strips,
            progress=lambda stage, done, total: progress.update(
                stage, done=done, total=total, unit=UNITS[stage]
            ),
        )
    num_bytes = target.stat().st_size
    if as_json:
        print_json({"report": str(target), "bytes": num_bytes})
        return
    click.echo(f"{printable(str(target))}: written, {size(num_bytes)}")
    remark("Open it in a browser; it needs no network.", quiet=quiet)
