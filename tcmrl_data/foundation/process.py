"""What a process settles: how its threads wait, that it compiles nothing, and when it obeys signals.

Making or stepping an optimiser imports `torch._dynamo`, to tell the compiler where a graph has to break. That
takes 1.8 s of processor time in every worker and at the start of every training; without it, 0.03 s.
"""

import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, ModuleType
from typing import Any, final

SPINS = "1000"
"""On two cores that other programs share, a small training with two threads made 0.3 steps a second with GNU
OpenMP's default, which spins for milliseconds, and 13 with this: a spinning thread keeps the core from the
thread that it waits for. On idle cores both make 3 steps a second with networks of the paper's size, and 55
to 68 with small ones; threads that sleep at once make 33 of those.
"""


def sleep_soon() -> None:
    """Keeps OpenMP's threads from spinning for long, unless the environment says how they wait.

    Must run before torch is imported; processes started by this one inherit it.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)


COMPILER = "torch._dynamo"


class _StandIn(ModuleType):
    """Answers what optimisers ask of the compiler; whoever asks for more gets the compiler itself."""

    @staticmethod
    def disable(function: Callable[..., Any], *options: Any, **named: Any) -> Callable[..., Any]:
        return function

    @staticmethod
    def graph_break(reason: str = "") -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # `inspect` looks for `__file__` in every module
            raise AttributeError(name)
        if sys.modules.get(COMPILER) is self:
            del sys.modules[COMPILER]
        return getattr(importlib.import_module(COMPILER), name)


def leave_out_compiler() -> None:
    """Keeps torch from importing its compiler before something is compiled.

    For whole programs; a library must not do this to the programs that import it.
    """
    sys.modules.setdefault(COMPILER, _StandIn(COMPILER))


def open_closed_streams() -> None:
    """Opens the null device where the process was started without an input, output or error stream (`>&-`).

    A file that is opened later would otherwise get the stream's number, and what is printed would go into it.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115 # for the whole process


ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a process: Ctrl-C, the end of a job, the end of a terminal."""


@final
class DeferredInterrupts:
    """Holds back signals that end the process within its block; the earlier handlers get them afterwards.

    A training step that is broken off leaves half of the parameters updated, and no checkpoint can be made of
    them. SIGUSR1, as Slurm's `--signal` sends it ahead of the end of a job, asks for a checkpoint and ends
    nothing. Signals that the process ignores stay ignored. In a thread other than the main one, which hears
    no signals, nothing is held back.

    Example:
        >>> with DeferredInterrupts() as interrupts:
        ...     interrupts.received
        False
    """

    def __init__(self) -> None:
        self._number: int | None = None
        self._is_asked = False
        self._earlier: dict[signal.Signals, Any] = {}

    @property
    def received(self) -> bool:
        """Whether a signal that ends the process waits."""
        return self._number is not None

    @property
    def checkpoint_wanted(self) -> bool:
        """Whether a checkpoint should be written now: a signal waits, or SIGUSR1 has asked for one."""
        return self.received or self._is_asked

    def checkpoint_written(self) -> None:
        """Forgets that SIGUSR1 has asked."""
        self._is_asked = False

    def obey(self) -> None:
        """Gives a signal that waits to the earlier handlers now, and holds nothing back from here on."""
        earlier, self._earlier = self._earlier, {}
        for number, handler in earlier.items():
            signal.signal(number, handler)
        waiting, self._number = self._number, None
        if waiting is not None:
            signal.raise_signal(waiting)

    def __enter__(self) -> "DeferredInterrupts":
        if threading.current_thread() is threading.main_thread():
            heard = [number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN]
            self._earlier = {number: signal.signal(number, self._note) for number in heard}
            self._earlier[signal.SIGUSR1] = signal.signal(signal.SIGUSR1, self._ask)
        return self

    def __exit__(self, *exception: object) -> None:
        self.obey()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._number = number

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._is_asked = True
