"""Pushes and pulls that are killed at a request, and given again: nothing is lost or doubled."""

# ruff: noqa: F811 # fixtures of another file
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet

pytest.importorskip("obstore", reason="needs the extra `remote`")
pytest.importorskip("moto", reason="needs the extra `test`")

from tcmrl_data import open_dataset, verify_dataset
from tcmrl_data.foundation.disk import STAGING
from tcmrl_data.remote.address import parse_address
from tcmrl_data.remote.objects import Objects
from tcmrl_data.store.tables import part_file
from tests.remotes import (  # noqa: F401 # fixtures
    Proxy,
    bucket,
    frozen,
    own_fetched_parts,
    sealed_files,
    server,
)

START = "from tcmrl_cli.data import main; main()"


def in_sweeps(value: object) -> ParameterSet:
    return pytest.param(value, marks=pytest.mark.sweep)


ANSWERED = pytest.mark.parametrize("answered", [in_sweeps(False), True], ids=["asked", "answered"])


def chosen(number: int, sweep: int) -> range:
    """The requests of so many at which a command is killed: one, and all in sweeps."""
    return range(number) if sweep == 1 else range(2 * number // 3, 2 * number // 3 + 1)


def kill_at(server: Proxy, spoilt: int | None, *, answered: bool, words: list[str]) -> int:
    """Runs a command, and kills it when it makes a request, or when that was answered; returns its end."""
    process = subprocess.Popen(
        [sys.executable, "-c", START, *words, "--quiet"],
        stdout=subprocess.DEVNULL,
    )

    def kill(number: int, method: str, path: str) -> str | None:
        if number == spoilt and not answered:
            process.kill()
            process.wait()
        return "kill" if number == spoilt and answered else None

    def after() -> None:
        process.kill()
        process.wait()

    server.reset(kill)
    server.after = after
    return process.wait()


@pytest.mark.check
@ANSWERED
@pytest.mark.parametrize("tag", [None, in_sweeps("v1")])
def test_a_killed_push_goes_on(
    bucket: str,
    server: Proxy,
    frozen: Path,
    sweep: int,
    answered: bool,
    tag: str | None,
) -> None:
    more = ["--tag", tag] if tag else []
    assert (
        kill_at(server, None, answered=answered, words=["push", str(frozen), f"{bucket}-straight", *more])
        == 0
    )
    number, expected = len(server.log), names_at(f"{bucket}-straight")
    assert {part_file(key) for key in open_dataset(frozen).parts} < expected
    for spoilt in chosen(number, sweep):
        words = ["push", str(frozen), f"{bucket}-{spoilt}", *more]
        assert kill_at(server, spoilt, answered=answered, words=words) == -9
        assert kill_at(server, None, answered=answered, words=words) == 0
        assert names_at(f"{bucket}-{spoilt}") == expected
        opened = open_dataset(f"{bucket}-{spoilt}@{tag}" if tag else f"{bucket}-{spoilt}")
        opened.fetch()
        assert opened.manifest.digest == open_dataset(frozen).manifest.digest
        shutil.rmtree(os.environ["TCMRL_CACHE"])


def names_at(url: str) -> set[str]:
    """The files at an address."""
    return set(Objects(parse_address(url)).listing())


@pytest.mark.check
@ANSWERED
@pytest.mark.parametrize("selected", [False, in_sweeps(True)], ids=["whole", "selected"])
def test_a_killed_pull_goes_on(
    bucket: str,
    server: Proxy,
    frozen: Path,
    tmp_path: Path,
    sweep: int,
    answered: bool,
    selected: bool,
) -> None:
    more = ["--snapshots", "last"] if selected else []
    assert kill_at(server, None, answered=answered, words=["push", str(frozen), bucket]) == 0
    straight = ["pull", bucket, str(tmp_path / "straight"), *more]
    assert kill_at(server, None, answered=answered, words=straight) == 0
    number = len(server.log)
    for spoilt in chosen(number, sweep):
        out = tmp_path / f"out-{spoilt}"
        shutil.rmtree(os.environ["TCMRL_CACHE"])
        words = ["pull", bucket, str(out), *more]
        assert kill_at(server, spoilt, answered=answered, words=words) == -9
        assert kill_at(server, None, answered=answered, words=words) == 0
        assert sealed_files(out) == sealed_files(tmp_path / "straight")
        assert verify_dataset(out, level="digests", strict=True).findings == ()
        assert not any((out / STAGING).iterdir())
