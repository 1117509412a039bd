"""How long the threads of a command wait for each other."""

import os
import subprocess
import sys

import pytest

PRINT_SETTING = """
import os
import click
from tcmrl_cli.frame import main_program

@click.command()
def setting():
    click.echo(str(os.environ.get("GOMP_SPINCOUNT")))

main_program(setting)
"""


@pytest.mark.parametrize(
    ("environment", "setting"),
    [({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "None")],
)
def test_commands_let_waiting_threads_sleep_unless_told_otherwise(
    environment: dict[str, str], setting: str
) -> None:
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("OMP_", "GOMP_"))}
    done = subprocess.run(
        [sys.executable, "-c", PRINT_SETTING],
        env=kept | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == setting
