"""Completion: what real shells are told."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent
PROGRAMS = {"tcmrl-data": "_tcmrl_data_completion", "tcmrl": "_tcmrl_completion"}


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    return os.environ | {"PATH": f"{BIN}:{os.environ['PATH']}"}


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]) -> Path:
    """A folder with the bash script of each program."""
    folder = tmp_path_factory.mktemp("scripts")
    for program in PROGRAMS:
        environment |= {f"_{program}_COMPLETE".replace("-", "_").upper(): "bash_source"}
        result = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
        assert result.stderr == ""
        (folder / program).write_text(result.stdout)
    return folder


def in_bash(scripts: Path, environment: dict[str, str], *words: str) -> list[str]:
    """What bash offers for the last word."""
    program = words[0]
    script = (
        f"source {scripts / program}\n"
        f"complete -p {program} | grep -q -- '-F {PROGRAMS[program]}' || exit 9\n"
        'COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))\n'
        "compopt() { COMPREPLY=(FILES); }\n"  # bash's own works only while a person completes
        f"{PROGRAMS[program]} {program}\n"
        'printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    command = ["bash", "--norc", "-c", script, "bash", *words]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return result.stdout.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("tcmrl-data ins", ["inspect"]),
        ("tcmrl-data show my", ["FILES"]),
        ("tcmrl-data build wal", ["walker-rand-params"]),
        ("tcmrl-data build my", ["FILES"]),
        ("tcmrl-data export data/point-robot --tier medium-r", ["medium-replay"]),
        ("tcmrl-data export data/point-robot --format hd", ["hdf5"]),
        ("tcmrl train --algo task", ["task_known"]),
        ("tcmrl evaluate runs/first --protocol pap", ["paper"]),
        ("tcmrl experiment tou", ["tour"]),
    ],
)
def test_bash_completes(scripts: Path, environment: dict[str, str], line: str, expected: list[str]) -> None:
    assert in_bash(scripts, environment, *line.split(" ")) == expected


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_scripts_of_other_shells_are_sound(
    shell: str, environment: dict[str, str], tmp_path: Path
) -> None:
    environment |= {"_TCMRL_DATA_COMPLETE": f"{shell}_source"}
    result = subprocess.run("tcmrl-data", env=environment, capture_output=True, text=True, check=True)
    script = result.stdout
    assert f"_TCMRL_DATA_COMPLETE={shell}_complete" in script
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    (tmp_path / "script").write_text(script)
    subprocess.run([shell, "-n", str(tmp_path / "script")], check=True)
