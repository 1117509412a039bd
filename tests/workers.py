"""Processes of builds: finding them from outside, which Linux tells by /proc, and starting them."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.directed import Directions

MARK = "TCMRL_TEST_MARK"
ROOT = Path(__file__).parents[1]
PATIENCE = 240.0
"""Seconds after which what is waited for counts as hanging; nothing depends on how long it takes."""
WORKERS = (b"tcmrl_data.build.worker", b"tests.directed")


def worker_pids(mark: str) -> list[int]:
    """Live worker processes that inherited a mark in their environment."""
    return [pid for pid in marked_pids(mark) if _module(pid) in WORKERS]


def _module(pid: int) -> bytes:
    """The module that a process was started with, by `python -m`."""
    _, _, module = (*_read(pid, "cmdline").split(b"\0"), b"", b"", b"")[:3]
    return module


def marked_pids(mark: str) -> list[int]:
    """Live processes that inherited a mark in their environment, this one's children and theirs."""
    wanted = f"{MARK}={mark}".encode()
    pids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
    return [pid for pid in pids if wanted in _read(pid, "environ").split(b"\0")]


def ancestors(pid: int) -> list[int]:
    """Parents of a process, nearest first."""
    found = []
    while pid > 1:
        fields = _read(pid, "stat").rpartition(b")")[2].split()
        pid = int(fields[1]) if fields else 0
        found.append(pid)
    return found


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Waits until something is so; the deadline only ends what would hang."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE:g} s"
        time.sleep(0.005)


@contextlib.contextmanager
def command_line(
    *arguments: str,
    program: str = "tcmrl-data",
    directions: "Directions | None" = None,
    mark: str | None = None,
) -> Iterator["subprocess.Popen[str]"]:
    """A running `tcmrl-data` or `tcmrl` in a session of its own, killed at the end if it still runs.

    It hears Ctrl-C even where the tests themselves run in the background of a shell, which ignores it.

    Args:
        arguments: what follows the program's name.
        program: `tcmrl-data` or `tcmrl`.
        directions: for the workers that it starts.
        mark: stands in the environment of its processes instead of the session's.
    """
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += f"from tcmrl_cli.{'data' if program == 'tcmrl-data' else 'train'} import main\n"
    code += (
        f"from tests.directed import Directions, run_directed; run_directed(main, {directions!r})"
        if directions
        else "main()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        env=os.environ | ({MARK: mark} if mark else {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _read(pid: int, name: str) -> bytes:
    try:
        return Path(f"/proc/{pid}/{name}").read_bytes()
    except OSError:  # it has ended
        return b""
