"""`tcmrl-data render`: a film or pictures of a stored episode."""

import dataclasses
from pathlib import Path

import click

from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable

from .frame import number, output_options, print_json
from .progress import StageProgress


@click.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("--task", type=click.IntRange(min=0), required=True, help="Index of the task.")
@click.option(
    "--step", type=click.IntRange(min=0), show_default="the last one", help="Training step of the snapshot."
)
@click.option(
    "--episode", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the episode."
)
@click.option("--run", default="main", show_default=True, metavar="NAME", help="Run of the dataset.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    metavar="FILE",
    help="File to write: .webp or .mp4 for a film, .png for a strip of stills.",
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
    quiet: bool,
) -> None:
    """Draw a stored episode of DATASET as a film or a strip of pictures.

    The episode is played again from its stored seed and actions. Every observation, reward and end must be
    equal to the stored one bit for bit, otherwise nothing is written and the first step that differs is
    named. Simulated robots need OpenGL: a graphics driver, or Mesa's libegl1 or libosmesa6, which draw on the
    processor. MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses one. A film of the kind .mp4 needs ffmpeg.

    \b
    Examples:
      tcmrl-data render data/point-robot --task 7 --out task-7.webp
      tcmrl-data render data/half-cheetah-vel --task 3 --step 10000 --episode 2 --out strip.png
    """
    import tcmrl_data

    with StageProgress(quiet=quiet) as progress:
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
