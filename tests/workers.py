"""Finding worker processes from outside, to kill them: Linux tells by /proc."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

MARK = "TCMRL_TEST_MARK"
ROOT = Path(__file__).parents[1]


def worker_pids(mark: str) -> list[int]:
    """Live worker processes that inherited a mark in their environment."""
    return [pid for pid in marked_pids(mark) if b"tcmrl_data.build.worker" in _read(pid, "cmdline")]


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


def wait_for(condition: Callable[[], object], what: str, seconds: float = 60.0) -> None:
    """Waits until something is so."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {seconds} s"
        time.sleep(0.005)


@contextlib.contextmanager
def killer(mark: str, when: Callable[[], object], kills: int) -> Iterator[list[int]]:
    """Kills the first marked workers that live while `when` holds; yields the list of their pids."""
    killed: list[int] = []
    over = threading.Event()

    def watch() -> None:
        while len(killed) < kills and not over.is_set():
            victims = set(worker_pids(mark)) - set(killed) if when() else set()
            for pid in list(victims)[: kills - len(killed)]:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)
            time.sleep(0.005)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def command_line(*arguments: str, program: str = "tcmrl-data") -> Iterator["subprocess.Popen[str]"]:
    """A running `tcmrl-data` or `tcmrl` in a session of its own, killed at the end if it still runs.

    It hears Ctrl-C even where the tests themselves run in the background of a shell, which ignores it.
    """
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code += f"; from tcmrl_cli.{'data' if program == 'tcmrl-data' else 'train'} import main; main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
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
