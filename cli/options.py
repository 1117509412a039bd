"""Options that several commands take alike."""

import click

from tcmrl_data.recipe import PROFILES

from .places import complete_training_keys

PROCESSES = click.option(
    "--workers", type=click.IntRange(min=1), show_default="all cores", help="Number of processes."
)
SIMULTANEOUS_RUNS = click.option(
    "--workers", type=click.IntRange(min=1), show_default="one per core", help="Number of simultaneous runs."
)
TRAINING_PROFILE = click.option(
    "--profile",
    type=click.Choice(PROFILES),
    show_default="the dataset's",
    help="Profile of the training settings.",
)
TRAINING_SETTINGS = click.option(
    "--set",
    "overrides",
    shell_complete=complete_training_keys,
    metavar="SECTION.KEY=VALUE",
    multiple=True,
    help="Override a training setting; repeatable.",
)
DEVICE = click.option(
    "--device", default="cpu", show_default=True, help="PyTorch device, such as cpu or cuda."
)
