"""`tcmrl-data diff`, `report` and `render`: datasets compared, described on a page, and drawn."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import size

from .frame import INCOMPLETE, number, output_options, print_json, remark, stopped_by_signals
from .options import DATASET, DATASET_PATH, FILE, INDEX, beside
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import DatasetDiff, DiffLevel

MOST_LINES = 8
"""Lines of one kind that are printed; `--json` has all."""


@click.command()
@click.argument("left", metavar="DATASET", type=DATASET_PATH)
@click.argument("right", metavar="OTHER", type=DATASET_PATH)
@click.option(
    "--level",
    type=click.Choice(["manifest", "statistics", "arrays"]),
    default="statistics",
    show_default=True,
    help="How deep to read: manifests and tables, records of parts, or the first part that differs.",
)
@output_options
def diff(left: Path, right: Path, level: "DiffLevel", as_json: bool) -> None:
    """Say what differs between DATASET and OTHER, and why.

    Of the first part that differs, the first cause is named: data version, settings, seed, task parameters,
    derivation, policy, or arrays. The exit code is 0 for equal roots and 1 for others.

    \b
    Examples:
      tcmrl-data diff data/point-robot copy/point-robot
      tcmrl-data diff data/seed0 data/seed1 --level arrays --json
    """
    import tcmrl_data

    found = tcmrl_data.diff_datasets(left, right, level=level)
    if as_json:
        document = dataclasses.asdict(found) | {"left": str(found.left), "right": str(found.right)}
        print_json(document | {"same_root": found.same_root, "is_empty": found.is_empty})
    else:
        for line in _lines(found):
            click.echo(printable(line))
    if not found.same_root:
        click.get_current_context().exit(INCOMPLETE)


def _lines(found: "DatasetDiff") -> Iterator[str]:
    roots = [root[:12] for root in found.roots]
    if found.is_empty:
        yield f"equal: root {roots[0]}, {found.equal:,} parts"
        return
    yield (
        f"root          {roots[0]} → {roots[1]}"
        if not found.same_root
        else f"root          {roots[0]}, equal"
    )
    for title, changes in (
        ("recipe", found.recipe),
        ("runs", found.runs),
        ("platforms", found.platforms),
        ("tasks", found.tasks),
    ):
        for change in changes[:MOST_LINES]:
            yield f"{title:<13} {change.name}  {_value(change.left)} → {_value(change.right)}"
        if len(changes) > MOST_LINES:
            yield f"{title:<13} and {len(changes) - MOST_LINES:,} more"
    counts = (found.equal, len(found.different), len(found.left_only), len(found.right_only))
    yield "parts         {:,} equal, {:,} differ, {:,} left only, {:,} right only".format(*counts)
    if found.returns is not None:
        of = found.returns
        ends = "" if of.low is None else f", 95% {of.low:.3g} to {of.high:.3g} (Welch, over tasks)"
        yield f"returns       {of.left:.4g} → {of.right:.4g}, difference {of.difference:.3g}{ends}"
    if found.observations is not None:
        seen = found.observations
        shift = "" if seen.shift is None else f", {seen.shift:.2g} standard deviations"
        yield f"observations  column {seen.column}: mean {seen.left:.4g} → {seen.right:.4g}{shift}"
    if found.first is not None:
        yield f"first         {found.first.key}: {found.first.stage}: {found.first.detail}"
        if found.first.platform:
            yield f"              made on other platforms: {'; '.join(found.first.platform)}"


def _value(value: object) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


UNITS = {"reading": "parts", "playing": "episodes", "drawing": "figures"}
NOTHING_KEPT = "nothing was written; run the same command again"


@click.command(name="report")
@DATASET
@click.option(
    "--out",
    type=FILE,
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
@output_options
def dataset_report(dataset: Path, out: Path | None, episodes: int, transfer: bool, as_json: bool) -> None:
    """Write a page that shows what is in DATASET.

    The page is one HTML file that needs no network: verdicts, learning curves, returns, states that the tasks
    visit, trajectories, actions, whole episodes, tasks and provenance. It prints on paper. Needs plotly:
    pip install 'tcmrl[report]'.

    \b
    Examples:
      tcmrl-data report data/point-robot
      tcmrl-data report data/point-robot --out report.html --episodes 40
      tcmrl-data report data/point-robot --transfer
    """
    import tcmrl_data

    opened = tcmrl_data.open_dataset(dataset)
    target = out or beside(opened.path, "-report.html")
    with stopped_by_signals(lambda: NOTHING_KEPT), StageProgress() as progress:
        tcmrl_data.report_dataset(
            opened,
            target,
            episodes=episodes,
            transfer=transfer,
            progress=lambda stage, done, total: progress.update(
                stage, done=done, total=total, unit=UNITS[stage]
            ),
        )
    num_bytes = target.stat().st_size
    if as_json:
        print_json({"report": str(target), "bytes": num_bytes})
        return
    click.echo(f"{printable(str(target))}: written, {size(num_bytes)}")
    remark("Open it in a browser; it needs no network.")


@click.command()
@DATASET
@click.option("--task", type=INDEX, required=True, help="Index of the task.")
@click.option("--step", type=INDEX, show_default="the last one", help="Training step of the snapshot.")
@click.option("--episode", type=INDEX, default=0, show_default=True, help="Number of the episode.")
@click.option("--run", default="main", show_default=True, metavar="RUN", help="Run of DATASET that is read.")
@click.option(
    "--out",
    type=FILE,
    required=True,
    metavar="FILE",
    help="File to write: .webp or .gif for a film, .png for a strip of stills.",
)
@click.option(
    "--frames",
    type=click.IntRange(1, 500),
    show_default="100 of a film, 5 of a strip",
    help="Most pictures, evenly spread over the episode.",
)
@click.option(
    "--width",
    type=click.IntRange(64, 640),
    default=320,
    show_default=True,
    help="Width of a picture in pixels.",
)
@output_options
def render(
    dataset: Path,
    task: int,
    step: int | None,
    episode: int,
    run: str,
    out: Path,
    frames: int | None,
    width: int,
    as_json: bool,
) -> None:
    """Draw a stored episode of DATASET as a film or a strip of pictures.

    The episode is played again from its stored seed and actions. Every observation, reward and end must be
    equal to the stored one bit for bit, otherwise nothing is written and the first step that differs is
    named. Simulated robots need OpenGL: a graphics driver, or Mesa's libegl1 or libosmesa6, which draw on the
    processor. MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses one.

    \b
    Examples:
      tcmrl-data render data/point-robot --task 7 --out task-7.webp
      tcmrl-data render data/half-cheetah-vel --task 3 --out strip.png
    """
    import tcmrl_data

    with StageProgress() as progress:
        rendered = tcmrl_data.render_episode(
            dataset,
            out,
            task=task,
            step=step,
            episode=episode,
            run=run,
            frames=frames,
            width=width,
            progress=lambda done, total: progress.update("replay", done=done, total=total, unit="steps"),
        )
    if as_json:
        print_json(dataclasses.asdict(rendered))
        return
    click.echo(
        f"{printable(str(rendered.file))}: task {rendered.task}, snapshot {rendered.step:,}, episode "
        f"{rendered.episode} with {rendered.steps:,} steps and return {number(rendered.reward)}, "
        f"equal bit for bit; {rendered.frames:,} frames, {size(rendered.bytes)}"
    )
