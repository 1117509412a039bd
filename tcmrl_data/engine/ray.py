"""The Ray engine: worker processes on a Ray cluster whose machines share the data folder.

A Ray task runs one attempt in a worker process on its machine and returns a digest; data never pass through
Ray. If Ray loses a machine it repeats the machine's tasks, so that a unit may run twice at the same time.
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
from tcmrl_data.engine.base import ATTEMPTS, BaseEngine, Message, NodeReport, Result, Unit, longest_first
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.machine import available_cores, size

LOST_RETRIES = 3
"""How often Ray repeats an attempt whose machine was lost."""

POLL_SECONDS = 0.2
CONNECT_SECONDS = 10.0
NODE_SECONDS = 60.0
"""Ray may take this long to start a process on a machine, beside the time of the unit."""

OBJECT_STORE_BYTES = 100_000_000
"""Object store of a local cluster. Only digests pass through it; Ray's default is 30 % of the memory."""


@final
class RayEngine(BaseEngine):
    """Runs units on the cluster at `address`, or on a local cluster that exists only during the run."""

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

    def run_on_every_node(self, unit: Unit) -> Sequence[NodeReport]:
        """One report per machine of the cluster; none for a cluster that is yet to be started here."""
        ray = _import_ray()
        if self.address is None and not ray.is_initialized():
            return ()
        with _connection(ray, self.workers, self.address):
            return _run_on_every_node(ray, unit)


class _Run:
    """The waiting and the running units of one call of `run`."""

    def __init__(self, ray: Any, units: Sequence[Unit], most_at_once: int) -> None:
        self._ray, self._most_at_once = ray, most_at_once
        self._waiting = deque((unit, 1) for unit in longest_first(units))
        self._running: dict[Any, tuple[Unit, int]] = {}
        self._mailbox = _start_mailbox(ray)

    def results(self, on_message: Message) -> Generator[Result, None, None]:
        """Yields one result per unit, as units end."""
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
        """Cancels the running units; kills those that do not end in time."""
        ray, references = self._ray, list(self._running)
        for reference in references:
            ray.cancel(reference)
        if references:
            _, running = ray.wait(references, num_returns=len(references), timeout=2 * GRACE_SECONDS)
            for reference in running:
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
        """How an attempt ended, and the name of its machine."""
        try:
            outcome, node = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            return Outcome(crash=_reason(error)), "the cluster"
        return outcome, node

    def _messages(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Messages since the last call; empty if the mailbox cannot be reached."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            messages: list[tuple[str, Mapping[str, Any]]] = self._ray.get(
                self._mailbox.take.remote(), timeout=GRACE_SECONDS
            )
            return messages
        return []


class _Mailbox:
    """Stores messages until the driver takes them; a Ray actor on the driver's machine."""

    def __init__(self) -> None:
        self._messages: list[tuple[str, Mapping[str, Any]]] = []

    def put(self, unit: str, message: Mapping[str, Any]) -> None:
        """Adds a message of a unit."""
        self._messages.append((unit, message))

    def take(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Returns and forgets the stored messages."""
        messages, self._messages = self._messages, []
        return messages


def _start_mailbox(ray: Any) -> Any:
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
    return ray.remote(_Mailbox).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here).remote()


def _supervise(unit: Unit, mailbox: Any) -> tuple[Outcome, str]:
    """Runs one attempt on a machine of the cluster; returns its outcome and the machine's name."""
    from ray.exceptions import RayError

    def on_message(message: Mapping[str, Any]) -> None:
        with contextlib.suppress(RayError):
            mailbox.put.remote(unit.id, message)

    return run_attempt(unit, on_message, threading.Event()), socket.gethostname()


def _run_on_every_node(ray: Any, unit: Unit) -> list[NodeReport]:
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    nodes = [node for node in ray.nodes() if node["Alive"] and _fits(node["Resources"], unit)]
    running = []
    for node in nodes:
        there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        task = ray.remote(_attempt_once).options(
            name=unit.id, num_cpus=0, max_retries=0, scheduling_strategy=there
        )
        running.append(task.remote(unit))
    patience = (unit.timeout or 0.0) + NODE_SECONDS
    ended, late = ray.wait(running, num_returns=len(running), timeout=patience) if running else ([], [])
    for reference in late:
        ray.cancel(reference, force=True)
    return [
        _node_report(ray, node, reference if reference in ended else None, patience)
        for node, reference in zip(nodes, running, strict=True)
    ]


def _node_report(ray: Any, node: Mapping[str, Any], reference: Any, patience: float) -> NodeReport:
    """What a machine answered; without a reference, that it did not."""
    name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
    if reference is None:
        return NodeReport(name, (), f"no answer within {patience:g} s")
    try:
        outcome, messages = ray.get(reference)
    except ray.exceptions.RayError as error:
        return NodeReport(name, (), _reason(error))
    return NodeReport(name, tuple(messages), outcome.error or outcome.crash)


def _attempt_once(unit: Unit) -> tuple[Outcome, list[Mapping[str, Any]]]:
    """Runs one attempt on a machine of the cluster; returns its outcome and its messages."""
    messages: list[Mapping[str, Any]] = []
    return run_attempt(unit, messages.append, threading.Event()), messages


def _reason(error: Exception) -> str:
    """The first line of the cause of an error of Ray's."""
    lines = str(getattr(error, "cause", None) or error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _import_ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read on import; no usage statistics by default
    try:
        import ray
    except ImportError as error:
        raise BuildError(
            f"engine 'ray' needs a package that is missing ({error}); pip install 'tcmrl[ray]'"
        ) from None
    return ray


@contextlib.contextmanager
def _connection(ray: Any, workers: int | None, address: str | None) -> Iterator[None]:
    """Connects to the cluster at `address`, or starts one; uses the program's connection if it has one."""
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
        signal.signal(signal.SIGTERM, on_sigterm)  # Ray's handler would end the driver without a message
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
    """Checks at once that a server listens at the address; Ray would try for minutes.

    Raises:
        OSError: no connection.
        ValueError: the address is not HOST:PORT.
    """
    if address != "auto":
        host, _, port = address.rpartition("://")[2].rpartition(":")
        socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()


def _refuse_unplaceable(nodes: Sequence[Mapping[str, Any]], units: Sequence[Unit]) -> None:
    """Checks that some machine can hold every unit; Ray would wait for ever for a larger one.

    Raises:
        BuildError: names the unit, the resources that it needs, and the machines.
    """
    machines = [node["Resources"] for node in nodes if node["Alive"]]
    for unit in units:
        if not any(_fits(machine, unit) for machine in machines):
            present = "; ".join(sorted({_resources(machine) for machine in machines}))
            raise BuildError(
                f"{unit.id} needs {_resources(_needed(unit))}, more than any machine of the cluster has "
                f"({present}); lower build.cpus, build.gpus or build.memory with --set, or add a machine"
            )


def _fits(machine: Mapping[str, float], unit: Unit) -> bool:
    """A machine with these resources could run the unit if it had nothing else to do."""
    return all(machine.get(name, 0) >= amount for name, amount in _needed(unit).items())


def _needed(unit: Unit) -> dict[str, float]:
    return {"CPU": unit.cpus, "GPU": unit.gpus, "memory": unit.memory}


def _resources(resources: Mapping[str, float]) -> str:
    cpus, gpus, memory = (resources.get(name, 0) for name in ("CPU", "GPU", "memory"))
    return f"{cpus:g} cpus, {gpus:g} gpus, {size(memory)}"
