"""The Ray engine: worker processes on a Ray cluster whose machines share the data folder.

A Ray task runs a unit in a worker process on its machine, as the local engine does, and returns a digest;
data never pass through Ray. Ray places the tasks by the resources of their units and repeats those of a
machine that is lost, so that a unit may run twice at the same time.
"""

import contextlib
import os
import signal
import socket
import threading
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from typing import Any, final

from tcmrl_data.engine.base import BaseEngine, Message, NodeReport, Result, Unit, longest_first
from tcmrl_data.engine.local import GRACE_SECONDS, Outcome, run_attempt, run_attempts
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.machine import available_cores, size

LOST_RETRIES = 3
"""How often Ray repeats a unit whose machine was lost."""

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
        from ray.util.queue import Queue

        self._ray, self._most_at_once = ray, most_at_once
        self._waiting = deque(longest_first(units))
        self._running: dict[Any, Unit] = {}
        self._messages = Queue(actor_options={"num_cpus": 0, "max_restarts": -1})

    def results(self, on_message: Message) -> Generator[Result, None, None]:
        """Yields one result per unit, as units end."""
        while self._waiting or self._running:
            while self._waiting and len(self._running) < self._most_at_once:
                self._submit(self._waiting.popleft())
            ended, _ = self._ray.wait(list(self._running), timeout=POLL_SECONDS)
            for message in self._take_messages():
                on_message(*message)
            for reference in ended:
                yield self._result(self._running.pop(reference), reference)

    def stop(self) -> None:
        """Cancels the running units; kills those that do not end in time."""
        ray, references = self._ray, list(self._running)
        for reference in references:
            ray.cancel(reference)
        if references:
            _, running = ray.wait(references, num_returns=len(references), timeout=2 * GRACE_SECONDS)
            for reference in running:
                ray.cancel(reference, force=True)
        self._messages.shutdown(force=True)

    def _submit(self, unit: Unit) -> None:
        task = self._ray.remote(_supervise).options(
            name=unit.id,
            num_cpus=unit.cpus,
            num_gpus=unit.gpus,
            memory=unit.memory or None,
            max_retries=LOST_RETRIES,
        )
        self._running[task.remote(unit, self._messages)] = unit

    def _result(self, unit: Unit, reference: Any) -> Result:
        try:
            result: Result = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            return Result(unit.id, False, None, _reason(error), LOST_RETRIES + 1, "the cluster")
        return result

    def _take_messages(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Messages since the last call; empty if the machine that holds them was lost."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            messages: list[tuple[str, Mapping[str, Any]]] = self._messages.get_nowait_batch(
                self._messages.qsize()
            )
            return messages
        return []


def _supervise(unit: Unit, messages: Any) -> Result:
    from ray.exceptions import RayError

    def on_message(message: Mapping[str, Any]) -> None:
        with contextlib.suppress(RayError):
            messages.put_nowait((unit.id, message))

    return run_attempts(unit, on_message, threading.Event())


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
    """Checks that some machine can hold every unit; Ray would wait for ever for a larger one."""
    machines = [node["Resources"] for node in nodes if node["Alive"]]
    for unit in units:
        if not any(_fits(machine, unit) for machine in machines):
            present = "; ".join(sorted({_resources(machine) for machine in machines}))
            raise BuildError(
                f"{unit.id} needs {_resources(_needed(unit))}, more than any machine of the cluster has "
                f"({present}); lower build.cpus, build.gpus or build.memory with --set, or add a machine"
            )


def _fits(machine: Mapping[str, float], unit: Unit) -> bool:
    return all(machine.get(name, 0) >= amount for name, amount in _needed(unit).items())


def _needed(unit: Unit) -> dict[str, float]:
    return {"CPU": unit.cpus, "GPU": unit.gpus, "memory": unit.memory}


def _resources(resources: Mapping[str, float]) -> str:
    cpus, gpus, memory = (resources.get(name, 0) for name in ("CPU", "GPU", "memory"))
    return f"{cpus:g} cpus, {gpus:g} gpus, {size(memory)}"
