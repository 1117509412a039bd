"""The process of one unit: `python -m tcmrl_data.engine.worker`, a JSON spec on standard input.

Messages go to standard output as JSON lines, the last one `{"kind": "result", "digest" | "error"}`.
The process ends when standard input closes, so that a killed driver leaves no orphan.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

from tcmrl_data.errors import TcmrlError
from tcmrl_data.unit import UnitSpec, run_unit

REPORT_SECONDS = 0.5


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
    sys.stdin.read()
    os._exit(1)


def main() -> None:
    """Runs the unit whose spec is the first line of standard input."""
    spec = UnitSpec.from_json(json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_the_driver, daemon=True).start()
    report = _Reporter()
    import torch

    torch.set_num_threads(1)  # digests depend on it: reductions split by thread round differently
    try:
        report({"kind": "result", "digest": run_unit(spec, report)})
    except TcmrlError as error:
        report({"kind": "result", "error": str(error)})


if __name__ == "__main__":
    main()
