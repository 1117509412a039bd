"""The engine inside the process, for tests and for units that take less time than a process's start."""

import importlib
import json
import socket
from collections.abc import Generator, Sequence
from typing import final

from tcmrl_data.engine.base import BaseEngine, Message, Result, Unit, longest_first
from tcmrl_data.foundation.errors import TcmrlError


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
