"""`completion`: the script with which a shell completes this program's command line."""

import click
from click.shell_completion import get_completion_class

SHELLS = ("bash", "zsh", "fish")


@click.command()
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print a script for SHELL that completes commands, options, environments, datasets, runs and more.

    Write it to a file that the shell reads when it starts.

    \b
    Examples:
      tcmrl-data completion bash >> ~/.bashrc
      tcmrl completion fish > ~/.config/fish/completions/tcmrl.fish
    """
    root = context.find_root()
    program = str(root.info_name)
    kind = get_completion_class(shell)
    assert kind is not None  # click has all of SHELLS
    variable = f"_{program}_COMPLETE".replace("-", "_").upper()
    click.echo(kind(root.command, {}, program, variable).source())
