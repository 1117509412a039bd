"""The Ray engine: the same worker processes, placed by a Ray cluster whose machines share the data folder.

A Ray task supervises one attempt on its machine and returns digests; data never travel through Ray. Ray tries
a task again whose machine was lost; that may run a unit twice at once, which units are made for.
"""

import contextlib
import os
import signal
import socket
import threading
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from typing import Any, final

from tcmrl_data.engine._attempt import GRACE_SECONDS, Outcome, run_attempt
from tcmrl_data.engine.base import ATTEMPTS, BaseEngine, Message, Result, Unit, longest_first
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.sizes import size

LOST_RETRIES = 3
"""How often Ray itself tries an attempt again that was lost with its machine."""

POLL_SECONDS = 0.2
CONNECT_SECONDS = 10.0
OBJECT_STORE_BYTES = 100_000_000
"""For a local cluster: nothing but digests passes through, and Ray's default is a third of the memory."""


@final
class RayEngine(BaseEngine):
    """Works on the cluster at `address`, or on one that is started here for the build and ended with it."""

    name = "ray"
    takes_address = True

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        ray = _import_ray()
        with _connection(ray, self.workers, self.address):
            _refuse_unplaceable(ray.nodes(), units)
            run = _Run(ray, units, self.workers or len(units))
            try:
                yield from run.results(on_message)
            finally:
                run.stop()


class _Run:
    """The units of one build: those that wait, and those that Ray has."""

    def __init__(self, ray: Any, units: Sequence[Unit], most_at_once: int) -> None:
        self._ray, self._most_at_once = ray, most_at_once
        self._waiting = deque((unit, 1) for unit in longest_first(units))
        self._running: dict[Any, tuple[Unit, int]] = {}
        self._mailbox = _start_mailbox(ray)

    def results(self, on_message: Message) -> Generator[Result, None, None]:
        """One result per unit, as units end."""
        while self._waiting or self._running:
            while self._waiting and len(self._running) < self._most_at_once:
                self._submit(*self._waiting.popleft())
            ended, _ = self._ray.wait(list(self._running), timeout=POLL_SECONDS)
            for message in self._messages():
                on_message(*message)
            for reference in ended:
                unit, attempt = self._running.pop(reference)
                outcome, node = self._outcome(reference)
                if outcome.crash and attempt < ATTEMPTS:
                    self._waiting.appendleft((unit, attempt + 1))
                else:
                    yield outcome.result(unit, attempt=attempt, node=node)

    def stop(self) -> None:
        """Ends what runs: first by asking, which lets workers clean up, then by force."""
        ray, references = self._ray, list(self._running)
        for reference in references:
            ray.cancel(reference)
        if references:
            _, left = ray.wait(references, num_returns=len(references), timeout=2 * GRACE_SECONDS)
            for reference in left:
                ray.cancel(reference, force=True)
        ray.kill(self._mailbox)

    def _submit(self, unit: Unit, attempt: int) -> None:
        task = self._ray.remote(_supervise).options(
            name=unit.id,
            num_cpus=unit.cpus,
            num_gpus=unit.gpus,
            memory=unit.memory or None,
            max_retries=LOST_RETRIES,
        )
        self._running[task.remote(unit, self._mailbox)] = (unit, attempt)

    def _outcome(self, reference: Any) -> tuple[Outcome, str]:
        """How an attempt ended, and where."""
        try:
            outcome, node = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            reason = str(getattr(error, "cause", None) or error).strip().splitlines()
            return Outcome(crash=reason[0] if reason else type(error).__name__), "the cluster"
        return outcome, node

    def _messages(self) -> list[tuple[str, Mapping[str, Any]]]:
        """What units have reported since; nothing while the mailbox is out of reach."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            messages: list[tuple[str, Mapping[str, Any]]] = self._ray.get(
                self._mailbox.take.remote(), timeout=GRACE_SECONDS
            )
            return messages
        return []


class _Mailbox:
    """Keeps messages until the driver asks for them; an actor on the driver's machine."""

    def __init__(self) -> None:
        self._messages: list[tuple[str, Mapping[str, Any]]] = []

    def put(self, unit: str, message: Mapping[str, Any]) -> None:
        """Adds a message of a unit."""
        self._messages.append((unit, message))

    def take(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Everything put since the last time."""
        messages, self._messages = self._messages, []
        return messages


def _start_mailbox(ray: Any) -> Any:
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
    return ray.remote(_Mailbox).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here).remote()


def _supervise(unit: Unit, mailbox: Any) -> tuple[Outcome, str]:
    """Runs on some machine of the cluster: one attempt, and that machine's name."""
    from ray.exceptions import RayError

    def on_message(message: Mapping[str, Any]) -> None:
        with contextlib.suppress(RayError):
            mailbox.put.remote(unit.id, message)

    return run_attempt(unit, on_message, threading.Event()), socket.gethostname()


def _import_ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read on import; nothing is sent unasked
    try:
        import ray
    except ImportError as error:
        raise BuildError(
            f"engine 'ray' needs a package that is missing ({error}); pip install 'tcmrl[ray]'"
        ) from None
    return ray


@contextlib.contextmanager
def _connection(ray: Any, workers: int | None, address: str | None) -> Iterator[None]:
    """Connects to the cluster at `address`, or starts one; a program's own connection is used as it is."""
    on_sigterm, connects = signal.getsignal(signal.SIGTERM), not ray.is_initialized()
    try:
        if address is not None:
            _knock(address)
        if connects:
            _connect(ray, workers, address)
    except (OSError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise BuildError(
            f"no connection to a Ray cluster at {address or 'this machine'}: {reason}; "
            "start one with `ray start --head`, or leave --ray-address out"
        ) from None
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_sigterm)  # Ray's own handler would end the driver without a word
    try:
        yield
    finally:
        if connects:
            ray.shutdown()


def _connect(ray: Any, workers: int | None, address: str | None) -> None:
    if address is not None:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        return
    ray.init(
        address="local",
        num_cpus=workers or available_cores(),
        object_store_memory=OBJECT_STORE_BYTES,
        include_dashboard=False,
        log_to_driver=False,
        logging_level="ERROR",
    )


def _knock(address: str) -> None:
    """Fails at once where nobody listens; Ray itself would try for minutes.

    Raises:
        OSError: no connection.
        ValueError: not HOST:PORT.
    """
    if address != "auto":
        host, _, port = address.rpartition("://")[2].rpartition(":")
        socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()


def _refuse_unplaceable(nodes: Sequence[Mapping[str, Any]], units: Sequence[Unit]) -> None:
    """Refuses a unit that is too large for every machine, which would wait for ever.

    Raises:
        BuildError: names the unit, what it asks for, and what machines there are.
    """
    machines = [node["Resources"] for node in nodes if node["Alive"]]
    for unit in units:
        wanted = {"CPU": unit.cpus, "GPU": unit.gpus, "memory": unit.memory}
        if not any(all(each.get(name, 0) >= wanted[name] for name in wanted) for each in machines):
            there = "; ".join(sorted({_resources(each) for each in machines}))
            raise BuildError(
                f"{unit.id} asks for {_resources(wanted)}, more than any machine of the cluster has "
                f"({there}); lower build.cpus, build.gpus or build.memory with --set, or add a machine"
            )


def _resources(resources: Mapping[str, float]) -> str:
    cpus, gpus, memory = (resources.get(name, 0) for name in ("CPU", "GPU", "memory"))
    return f"{cpus:g} cpus, {gpus:g} gpus, {size(memory)}"
