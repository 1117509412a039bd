"""`tcmrl-data new`: a package with an environment of one's own."""

from pathlib import Path

import click

from .frame import next_commands, output_options, print_json
from .options import PATH


@click.command()
@click.argument("name")
@click.option("--out", type=PATH, metavar="FOLDER", help="Folder to create; ./NAME by default.")
@output_options
def new(name: str, out: Path | None, as_json: bool) -> None:
    """Write a package with an environment of your own, ready to build.

    It holds an environment, its recipe and its tests. Replace the pendulum in it by your tasks.

    \b
    Examples:
      tcmrl-data new mountain-car
      pip install -e mountain-car
      tcmrl-data build mountain-car --profile quick

    One file does too: `tcmrl-data build my_env.py:MyEnv`, with my-env.toml beside it.
    """
    import tcmrl_data

    folder = out or Path(name)
    files = tcmrl_data.new_environment(name, folder)
    if as_json:
        print_json({"files": [str(file) for file in files]})
        return
    for file in files:
        click.echo(str(file))
    next_commands(("pip", "install", "-e", folder), ("tcmrl-data", "build", name, "--profile", "quick"))
