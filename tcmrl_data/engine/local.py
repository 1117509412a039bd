"""The engines of this machine: a worker process per unit, or the work inside this process."""

import contextlib
import importlib
import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO, Any, final

from tcmrl_data.engine.base import ATTEMPTS, BaseEngine, Message, Result, Unit, longest_first
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.machine import available_cores


@final
class LocalEngine(BaseEngine):
    """Runs up to `workers` processes on this machine; None for one per available core."""

    name = "local"

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        events: queue.SimpleQueue[tuple[str, Mapping[str, Any]] | Future[Result]] = queue.SimpleQueue()
        stopping = threading.Event()

        def run_unit(unit: Unit) -> Result:
            return run_attempts(unit, lambda message: events.put((unit.id, message)), stopping)

        pool = ThreadPoolExecutor(self.workers or available_cores())
        try:
            for unit in longest_first(units):
                pool.submit(run_unit, unit).add_done_callback(events.put)
            left = len(units)
            while left:
                event = events.get()
                if isinstance(event, Future):
                    left -= 1
                    yield event.result()
                else:
                    on_message(*event)
        finally:
            stopping.set()
            pool.shutdown(cancel_futures=True)


def run_attempts(
    unit: Unit, on_message: Callable[[Mapping[str, Any]], None], stopping: threading.Event
) -> Result:
    """Runs a unit in a worker process, in another one if that crashes; arguments as for `run_attempt`."""
    attempt, outcome = 0, Outcome(crash="stopped before it started")
    while outcome.crash and attempt < ATTEMPTS and not stopping.is_set():
        attempt += 1
        outcome = run_attempt(unit, on_message, stopping)
    return outcome.result(unit, attempt=attempt, node=socket.gethostname())


THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
POLL_SECONDS = 0.1
GRACE_SECONDS = 10.0
"""Seconds between SIGTERM and SIGKILL: a training ends its step and writes a checkpoint first."""


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended; exactly one of the three attributes is set.

    Attributes:
        digest: the unit's digest, if the unit is done.
        error: the error that the worker reported; the unit is not tried again.
        crash: how the worker ended, if it reported no result.
    """

    digest: str | None = None
    error: str | None = None
    crash: str | None = None

    def result(self, unit: Unit, *, attempt: int, node: str) -> Result:
        """The unit's result, after its last attempt."""
        return Result(unit.id, self.digest is not None, self.digest, self.error or self.crash, attempt, node)


def run_attempt(
    unit: Unit, on_message: Callable[[Mapping[str, Any]], None], stopping: threading.Event
) -> Outcome:
    """Runs a unit in a worker process and waits for the process to end.

    Args:
        unit: the unit.
        on_message: called from another thread with every message except the result.
        stopping: ends the worker when set.
    """
    with contextlib.ExitStack() as stack:
        errors = stack.enter_context(tempfile.TemporaryFile("w+", errors="replace"))
        try:
            process = stack.enter_context(_start_worker(unit, errors))
        except OSError as error:
            return Outcome(crash=f"no worker could be started: {error}")
        stack.callback(_hang_up, process)
        stack.callback(_end, process)  # before _hang_up: closed input makes a worker exit without cleanup
        last: list[Mapping[str, Any]] = []
        listener = threading.Thread(target=_listen, args=(process, on_message, last), daemon=True)
        listener.start()
        with contextlib.suppress(BrokenPipeError):  # the worker ended early; its exit code is reported below
            assert process.stdin is not None
            process.stdin.write(json.dumps(unit.spec) + "\n")
            process.stdin.flush()
        ended = _wait(process, unit.timeout, stopping)
        listener.join()
        if last:
            return Outcome(digest=last[-1].get("digest"), error=last[-1].get("error"))
        return Outcome(crash=ended or f"worker {_exit(process)}: {_last_line(errors)}")


def _start_worker(unit: Unit, errors: IO[str]) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "tcmrl_data.engine.worker", unit.worker],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        env=os.environ | dict.fromkeys(THREADS, str(unit.threads)),
        start_new_session=True,  # Ctrl-C reaches only the driver, which then ends its workers
    )


def _listen(
    process: "subprocess.Popen[str]",
    on_message: Callable[[Mapping[str, Any]], None],
    last: list[Mapping[str, Any]],
) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if not line.endswith("\n"):
            return  # the worker ended in the middle of a line
        message = json.loads(line)
        if message["kind"] == "result":
            last.append(message)
        else:
            on_message(message)


def _wait(process: "subprocess.Popen[str]", timeout: float | None, stopping: threading.Event) -> str | None:
    """Waits for the worker to end; returns the reason if this function ended it."""
    deadline = time.monotonic() + timeout if timeout is not None else float("inf")
    while True:
        try:
            process.wait(POLL_SECONDS)
            return None
        except subprocess.TimeoutExpired:
            if stopping.is_set():
                _end(process)
                return "stopped"
            if time.monotonic() > deadline:
                _end(process)
                return f"ran longer than its {timeout:g} s (build.timeout)"


def _end(process: "subprocess.Popen[str]") -> None:
    """Sends SIGTERM to a worker, and SIGKILL if it does not end in time."""
    process.terminate()
    try:
        process.wait(GRACE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _hang_up(process: "subprocess.Popen[str]") -> None:
    """Closes the worker's input; data that the worker has not read are dropped."""
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()


def _exit(process: "subprocess.Popen[str]") -> str:
    code = process.returncode
    return f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"


def _last_line(errors: IO[str]) -> str:
    errors.seek(0)
    lines = errors.read().strip().splitlines()
    return lines[-1] if lines else "no message"


@final
class InProcessEngine(BaseEngine):
    """Runs one unit after another in this process, each with its own number of torch threads.

    It makes the same data as the other engines. What needs a process of its own is missing: there is no
    timeout, a crash is not tried again but raised here, and memory is that of this process.
    """

    name = "in-process"

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        for unit in longest_first(units):
            yield _run_unit(unit, on_message)


def _run_unit(unit: Unit, on_message: Message) -> Result:
    import torch

    work = importlib.import_module(unit.worker).work
    threads, digest, error = torch.get_num_threads(), None, None
    torch.set_num_threads(unit.threads)
    try:
        digest = work(json.loads(json.dumps(unit.spec)), lambda message: on_message(unit.id, message))
    except TcmrlError as failure:
        error = str(failure)
    finally:
        torch.set_num_threads(threads)
    return Result(unit.id, error is None, digest, error, 1, socket.gethostname())
