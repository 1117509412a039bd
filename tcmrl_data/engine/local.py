"""The local engine: a supervisor with one subprocess per unit."""

import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Generator, Mapping, Sequence
from typing import Any, final

from tcmrl_data.engine import BaseEngine, Message, Result, Unit

NAME = "local"
ATTEMPTS = 2
"""A crashed or timed-out unit is run once more; an error that the unit reports itself is final."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@final
class Engine(BaseEngine):
    """Up to `workers` subprocesses at a time, longest units first."""

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        waiting: queue.SimpleQueue[Unit] = queue.SimpleQueue()
        for unit in sorted(units, key=lambda unit: -unit.cost):
            waiting.put(unit)
        events: queue.SimpleQueue[tuple[str, Mapping[str, Any]] | Result] = queue.SimpleQueue()
        running: set[subprocess.Popen[str]] = set()
        stopping = threading.Event()

        def work() -> None:
            while not stopping.is_set():
                try:
                    unit = waiting.get_nowait()
                except queue.Empty:
                    return
                events.put(_run_attempts(unit, events, running, stopping))

        threads = [threading.Thread(target=work, daemon=True) for _ in range(min(self.workers, len(units)))]
        for thread in threads:
            thread.start()
        try:
            left = len(units)
            while left:
                event = events.get()
                if isinstance(event, Result):
                    left -= 1
                    yield event
                else:
                    on_message(*event)
        finally:
            stopping.set()
            for process in list(running):
                process.kill()
            for thread in threads:
                thread.join()


def _run_attempts(
    unit: Unit,
    events: "queue.SimpleQueue[tuple[str, Mapping[str, Any]] | Result]",
    running: set[subprocess.Popen[str]],
    stopping: threading.Event,
) -> Result:
    attempt = 0
    final_message, failure = None, "stopped before it started"
    while final_message is None and attempt < ATTEMPTS and not stopping.is_set():
        attempt += 1
        final_message, failure = _run_once(unit, events, running)
    reported = final_message or {}
    error = None if reported.get("digest") else reported.get("error", failure)
    return Result(unit.id, error is None, reported.get("digest"), error, attempt, socket.gethostname())


def _run_once(
    unit: Unit,
    events: "queue.SimpleQueue[tuple[str, Mapping[str, Any]] | Result]",
    running: set[subprocess.Popen[str]],
) -> tuple[Mapping[str, Any] | None, str]:
    """The unit's own last word, or None and why there is none."""
    last: Mapping[str, Any] | None = None
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [sys.executable, "-m", "tcmrl_data.engine.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=os.environ | ONE_THREAD,
        ) as process,
    ):
        running.add(process)
        timer = threading.Timer(unit.timeout or threading.TIMEOUT_MAX, process.kill)
        timer.start()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(unit.spec) + "\n")
            process.stdin.flush()
            for line in process.stdout:
                message = json.loads(line)
                if message["kind"] == "result":
                    last = message
                else:
                    events.put((unit.id, message))
        except BrokenPipeError:
            pass  # the worker died before it read its spec; its exit code says how
        finally:
            timer.cancel()
            code = process.wait()
            running.discard(process)
        errors.seek(0)
        lines = errors.read().strip().splitlines()
    return last, f"worker ended with code {code}: {lines[-1] if lines else 'no message'}"
