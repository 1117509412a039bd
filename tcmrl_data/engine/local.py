"""The engines of this machine: one worker process per unit, or the work inside this process.

A worker is `python -m tcmrl_data.engine.local MODULE`. It reads a JSON spec from standard input, calls the
module's `work` and writes messages to standard output as JSON lines; the last one is
`{"kind": "result", "digest" | "error"}`. It ends when standard input closes, so that no worker outlives a
killed driver. On SIGTERM or SIGINT it abandons the unit: a behavior training first writes its checkpoint,
published parts stay, staged files are removed.
"""

import contextlib
import importlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import FrameType
from typing import IO, Any, final

from tcmrl_data.engine.base import ATTEMPTS, BaseEngine, Message, Result, Unit, longest_first
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.machine import available_cores, leave_out_compiler


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
        error: the error that the worker reported; the unit is not tried again.
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
        on_message: called from another thread with every message except the result.
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
        [sys.executable, "-m", "tcmrl_data.engine.local", unit.worker],
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


REPORT_SECONDS = 0.5

Send = Callable[[Mapping[str, Any]], None]
"""Receives a unit's messages. A message has a `kind`; messages of kind `steps` have a `count` to add up,
messages of kind `warning` a `message` for people."""


class _Reporter:
    """Writes messages as JSON lines; step counts are added up and written twice a second."""

    def __init__(self) -> None:
        self._output = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)  # the output of a library's print must not mix with messages
        self._steps, self._sent = 0, time.monotonic()

    def __call__(self, message: Mapping[str, Any]) -> None:
        if message["kind"] == "steps":
            self._steps += message["count"]
            if time.monotonic() - self._sent < REPORT_SECONDS:
                return
        if self._steps:
            self._write({"kind": "steps", "count": self._steps})
            self._steps, self._sent = 0, time.monotonic()
        if message["kind"] != "steps":
            self._write(message)

    def _write(self, message: Mapping[str, Any]) -> None:
        self._output.write(json.dumps(message) + "\n")
        self._output.flush()


def _end_with_the_driver() -> None:
    while os.read(0, 4096):  # not sys.stdin: holding its lock would abort the interpreter's shutdown
        pass
    os._exit(1)


def _abandon(signal_number: int, frame: FrameType | None) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)  # a second signal must not interrupt the cleanup
    raise SystemExit(128 + signal_number)


def serve(module: str) -> None:
    """Runs the unit whose spec is the first line of standard input, reports its result and ends the process.

    Args:
        module: its `work` takes a spec and a receiver of messages, and returns the digest of the work done. A
            `TcmrlError` that it raises becomes the unit's error; the unit is not tried again.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _abandon)
    leave_out_compiler()
    work = importlib.import_module(module).work
    spec = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_the_driver, daemon=True).start()
    report = _Reporter()
    try:
        report({"kind": "result", "digest": work(spec, report)})
    except TcmrlError as error:
        report({"kind": "result", "error": str(error)})
    sys.stderr.flush()
    os._exit(0)  # skips the shutdown of libraries, which takes a second


if __name__ == "__main__":
    serve(sys.argv[1])
