"""Ctrl-C and SIGTERM between two training steps instead of within one."""

import signal
import threading
from types import FrameType
from typing import Any, final

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@final
class DeferredInterrupts:
    """Holds back Ctrl-C and SIGTERM within its block; the earlier handlers get them at its end.

    A step that is broken off leaves half of the parameters updated, and no checkpoint can be made of them. In
    a thread other than the main one, which hears no signals, nothing is held back.

    Example:
        >>> with DeferredInterrupts() as interrupts:
        ...     interrupts.received
        False
    """

    def __init__(self) -> None:
        self._number: int | None = None
        self._earlier: dict[signal.Signals, Any] = {}

    @property
    def received(self) -> bool:
        """Whether a signal waits."""
        return self._number is not None

    def __enter__(self) -> "DeferredInterrupts":
        if threading.current_thread() is threading.main_thread():
            self._earlier = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, handler)
        if self._number is not None:
            signal.raise_signal(self._number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._number = number
