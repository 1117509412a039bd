"""The local engine: one worker process per unit on this machine."""

import queue
import socket
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, final

from tcmrl_data.engine._attempt import Outcome, run_attempt
from tcmrl_data.engine.base import ATTEMPTS, BaseEngine, Message, Result, Unit, longest_first
from tcmrl_data.foundation.machine import available_cores


@final
class LocalEngine(BaseEngine):
    """Runs up to `workers` processes on this machine; None for one per available core."""

    name = "local"

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        events: queue.SimpleQueue[tuple[str, Mapping[str, Any]] | Future[Result]] = queue.SimpleQueue()
        stopping = threading.Event()

        def run_unit(unit: Unit) -> Result:
            return _run_attempts(unit, lambda message: events.put((unit.id, message)), stopping)

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


def _run_attempts(
    unit: Unit, on_message: Callable[[Mapping[str, Any]], None], stopping: threading.Event
) -> Result:
    attempt, outcome = 0, Outcome(crash="stopped before it started")
    while outcome.crash and attempt < ATTEMPTS and not stopping.is_set():
        attempt += 1
        outcome = run_attempt(unit, on_message, stopping)
    return outcome.result(unit, attempt=attempt, node=socket.gethostname())
