"""Runs commands on a small or read-only disk, in a separate mount namespace, as root or not."""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

COMMAND_LINE = [sys.executable, "-c", "from tcmrl_cli.data import main; main()"]


def small_disk(folder: Path, kilobytes: int) -> str:
    """The shell command that mounts a small disk at a folder."""
    return f"mount -t tmpfs -o size={kilobytes}k tmpfs {shlex.quote(str(folder))}"


def read_only(folder: Path) -> str:
    """The shell command that makes a folder read-only."""
    place = shlex.quote(str(folder))
    return f"mount --bind {place} {place} && mount -o remount,bind,ro {place}"


def run_mounted(mount: str, *arguments: object, then: str = "true") -> "subprocess.CompletedProcess[str]":
    """Runs `tcmrl-data` after a mount that only this command sees; skips the test where a mount fails.

    Args:
        mount: shell command.
        arguments: of the command line.
        then: shell command that runs afterwards, with the mount still there; prints to standard output.
    """
    if shutil.which("unshare") is None:
        pytest.skip("no disk can be mounted here: no program unshare (util-linux)")
    probe = _unshared(mount)
    if probe.returncode:
        pytest.skip(f"no disk can be mounted here: {probe.stderr.strip()}")
    command = shlex.join([*COMMAND_LINE, *map(str, arguments)])
    return _unshared(f"{mount} && {{ {command}; code=$?; {then}; exit $code; }}")


def _unshared(command: str) -> "subprocess.CompletedProcess[str]":
    user: Sequence[str] = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return subprocess.run(
        ["unshare", "--mount", *user, "sh", "-c", command], capture_output=True, text=True, check=False
    )
