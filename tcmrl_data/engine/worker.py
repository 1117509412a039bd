"""The worker process of a unit, `python -m tcmrl_data.engine.worker MODULE`, whatever the unit is.

It reads a JSON spec from standard input, calls the module's `work` and writes messages to standard output as
JSON lines; the last one is `{"kind": "result", "digest" | "error"}`. The process ends when standard input
closes, so that no worker outlives a killed driver. On SIGTERM or SIGINT it abandons the unit: a behavior
training first writes its checkpoint, published parts stay, staged files are removed.
"""

import importlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any

from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.machine import leave_out_compiler

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
