"""The worker's side of a unit's process: a JSON spec on standard input, messages on standard output.

A module becomes a worker by calling `serve`; engines run it as `python -m <module>`. Messages go to standard
output as JSON lines, the last one `{"kind": "result", "digest" | "error"}`.
The process ends when standard input closes, so that a killed driver leaves no orphan. On SIGTERM it abandons
the unit: what it published stands, what it had staged is removed.
"""

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

REPORT_SECONDS = 0.5

Send = Callable[[Mapping[str, Any]], None]
"""Receives a unit's messages; each has a `kind`, and those of kind `steps` a `count` to add up."""


class _Reporter:
    """Writes messages as JSON lines; step counts are gathered so that they cost nothing."""

    def __init__(self) -> None:
        self._output = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)  # a library that prints must not break the message stream
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
    while os.read(0, 4096):  # not sys.stdin: its lock, held here, would abort the interpreter's own end
        pass
    os._exit(1)


def _abandon(signal_number: int, frame: FrameType | None) -> None:
    signal.signal(signal_number, signal.SIG_IGN)  # asked again, it goes on cleaning up
    raise SystemExit(128 + signal_number)


def serve(work: Callable[[dict[str, Any], Send], str]) -> None:
    """Makes this process a worker: does the unit whose spec is the first line of standard input.

    Args:
        work: from a spec and a receiver of messages to the digest of what was done; what it raises as
            `TcmrlError` is the unit's error and is not tried again.
    """
    signal.signal(signal.SIGTERM, _abandon)
    spec = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_the_driver, daemon=True).start()
    report = _Reporter()
    try:
        report({"kind": "result", "digest": work(spec, report)})
    except TcmrlError as error:
        report({"kind": "result", "error": str(error)})
    sys.stderr.flush()
    os._exit(0)  # all is written and told; taking the libraries down in order would take a second
