"""Processes of builds: finding them through Linux's /proc, and starting them."""

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
WORKERS = (b"tcmrl_data.building.plan", b"tests.directed")


def worker_pids(mark: str) -> list[int]:
    """Live worker processes that inherited a mark in their environment."""
    return [pid for pid in marked_pids(mark) if _module(pid) in WORKERS]


def _module(pid: int) -> bytes:
    """The module whose work a worker process does; empty for any other process."""
    _, _, entry, module = (*_read(pid, "cmdline").split(b"\0"), b"", b"", b"", b"")[:4]
    return module if entry == b"tcmrl_data.engine.local" else b""


def marked_pids(mark: str) -> list[int]:
    """Live processes that inherited a mark in their environment: children of this one, and their children."""
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
    """Waits until a condition holds; the deadline only ends a wait that would never end."""
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
    """A running `tcmrl-data` or `tcmrl` in a separate session, killed at the end if it still runs.

    It receives Ctrl-C even if the tests run in the background of a shell, where Ctrl-C is ignored.

    Args:
        arguments: what follows the program's name.
        program: `tcmrl-data` or `tcmrl`.
        directions: for the workers that it starts.
        mark: replaces the session's mark in the environment of its processes.
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


def other_version(folder: Path, package: str) -> dict[str, str]:
    """Variables under which processes find version 0.0.7 of a package; writes its metadata below a folder."""
    place = folder / f"other-{package}"
    metadata = place / f"{package}-0.0.7.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True)
    metadata.write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.0.7\n")
    return {"PYTHONPATH": os.pathsep.join([str(place), str(ROOT)])}
