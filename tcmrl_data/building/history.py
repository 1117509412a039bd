"""What the events of a build add up to, in bounded memory; can be written as one event and read back."""

from collections import deque
from collections.abc import Mapping
from typing import Any, final

WINDOW_SECONDS = 60
"""Training speed is measured over this time."""

MAX_FAILURES = 100
MAX_RUNNING = 10_000
"""Of more failed or running units the latest are remembered."""


@final
class History:
    """The latest build, from its events in order; equal before and after it was summed up.

    Attributes:
        running: ids of the units at work, in the order of their first events.
        failed: messages of the latest failed units.
        num_failed: how many units failed.
        last: the latest event; None before the first.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.running: dict[str, None] = {}
        self.failed: deque[str] = deque(maxlen=MAX_FAILURES)
        self.num_failed = 0
        self.last: Mapping[str, Any] | None = None
        self._paces: dict[int, tuple[float, int]] = {}  # second: time and steps of its first event

    def add(self, event: Mapping[str, Any]) -> None:
        """Adds the next event of the record, or a summary of all events before."""
        kind, unit = event["kind"], event["unit"]
        if kind == "rotated":
            self._restore(event["summary"])
        elif kind == "start":
            self._clear()
        elif kind in ("unit_done", "unit_failed"):
            self.running.pop(unit, None)
        elif unit:
            self.running[unit] = None
            if len(self.running) > MAX_RUNNING:
                del self.running[next(iter(self.running))]
        if kind == "unit_failed":
            self.failed.append(event["message"])
            self.num_failed += 1
        self.last = event
        self._measure(event["time"], event["steps_done"])

    def _measure(self, time: float, steps: int) -> None:
        now = int(time)
        if now not in self._paces:
            self._paces[now] = (time, steps)
            self._paces = {
                second: pace for second, pace in self._paces.items() if 0 <= now - second <= WINDOW_SECONDS
            }

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps of behavior training over the latest minute; None if there were none."""
        if self.last is None:
            return None
        time, steps = self._paces[min(self._paces)]
        seconds, steps = self.last["time"] - time, self.last["steps_done"] - steps
        return float(steps / seconds) if seconds > 0 and steps > 0 else None

    def summary(self) -> dict[str, Any] | None:
        """An event that stands for all events so far; None if there were none."""
        if self.last is None:
            return None
        summary = {
            "running": list(self.running),
            "failed": list(self.failed),
            "num_failed": self.num_failed,
            "paces": list(self._paces.values()),
        }
        return {**self.last, "kind": "rotated", "unit": None, "message": "", "summary": summary}

    def _restore(self, summary: Mapping[str, Any]) -> None:
        self._clear()
        self.running = dict.fromkeys(summary["running"])
        self.failed.extend(summary["failed"])
        self.num_failed = summary["num_failed"]
        self._paces = {int(time): (time, steps) for time, steps in summary["paces"]}


def is_summary(value: object) -> bool:
    """True if a value read from a file is what `History.summary` writes; the file may be damaged."""
    if not isinstance(value, dict) or set(value) != {"running", "failed", "num_failed", "paces"}:
        return False
    texts = [value["running"], value["failed"]]
    return (
        all(isinstance(list_, list) and all(isinstance(text, str) for text in list_) for list_ in texts)
        and is_number(value["num_failed"])
        and isinstance(value["paces"], list)
        and all(isinstance(pace, list) and len(pace) == 2 for pace in value["paces"])
        and all(is_number(number) for pace in value["paces"] for number in pace)
    )


def is_number(value: object) -> bool:
    """True for a bounded int or float that is not NaN; a bool is no number."""
    return type(value) in (int, float) and abs(value) < 2**63  # type: ignore[arg-type]
