"""The machine and the process: processor, cores, memory and cache; how threads wait, when signals are obeyed.

The cores are counted here and not by `joblib.cpu_count`, which reads the quota of the outermost control group
alone: a job of Slurm or systemd in a group of its own would start as many workers as the machine has cores.
"""

import importlib
import os
import platform
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, final

from tcmrl_data.foundation.errors import CacheError

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUPS = Path("/proc/self/cgroup")
CPU_INFO = Path("/proc/cpuinfo")


def processor() -> str:
    """Model name of the processor; `unknown` where the system tells none."""
    lines = CPU_INFO.read_text().splitlines() if CPU_INFO.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "unknown"


def available_cores() -> int:
    """Cores available to this process, at least 1: the CPU affinity, limited by control group quotas."""
    cores = len(os.sched_getaffinity(0))
    return max(1, int(min([cores, *_cpu_quotas()])))


def available_memory() -> int:
    """Bytes available without swapping, as estimated by the kernel and limited by control groups."""
    return max(0, min([_machine_memory(), *_memory_quotas()]))


def resident_memory() -> int:
    """Bytes of memory that this process occupies."""
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def _machine_memory() -> int:
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _cpu_quotas() -> Iterator[float]:
    """The CPU quota, in cores, of every control group that has one."""
    for folder in _groups("cpu"):
        words = _words(folder / "cpu.max") or [
            *_words(folder / "cpu.cfs_quota_us"),
            *_words(folder / "cpu.cfs_period_us"),
        ]
        if len(words) == 2 and words[0].isdecimal() and int(words[1]):
            yield int(words[0]) / int(words[1])


def _memory_quotas() -> Iterator[int]:
    """Free bytes below the limit of every control group that has one; inactive page cache counts as free."""
    names = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
    for folder in _groups("memory"):
        for limit, usage in names:
            words = [*_words(folder / limit), *_words(folder / usage)]
            if len(words) == 2 and words[0].isdecimal():
                statistics = _words(folder / "memory.stat")
                cached = dict(zip(statistics[::2], statistics[1::2], strict=False)).get("inactive_file", "0")
                yield int(words[0]) - int(words[1]) + int(cached)


def _groups(controller: str) -> Iterator[Path]:
    """Folders of this process's control groups with a controller, and of their parent groups.

    A line of /proc/self/cgroup is `number:controllers:path`; version 2 names no controllers. In a container
    the group may be mounted as the root, so that the folder of the path does not exist.
    """
    lines = OWN_CGROUPS.read_text().splitlines() if OWN_CGROUPS.is_file() else []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        root = CGROUPS / controllers if controllers else CGROUPS
        group = Path(path.lstrip("/"))
        yield from (root / folder for folder in (group, *group.parents))


def _words(file: Path) -> list[str]:
    try:
        return file.read_text().split()
    except OSError:
        return []


UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def size(num_bytes: float) -> str:
    """A number of bytes as text in decimal units, such as `12.3 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if num_bytes < 1_000:
            return f"{num_bytes:.0f} B" if unit == "B" else f"{num_bytes:.1f} {unit}"
        num_bytes /= 1_000
    return f"{num_bytes:.1f} TB"


def parse_bytes(text: str) -> int:
    """Parses a size such as `2G`, `500M` or `1.5 GB` (decimal units) into bytes.

    Raises:
        CacheError: the text is not a size above 0.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kKMGT]?)B?", text.strip())
    num_bytes = int(float(match[1]) * UNITS[match[2].replace("K", "k")]) if match else 0
    if num_bytes < 1:
        raise CacheError(
            f"{text!r} is no size; write a number above 0 and one of B, k, M, G, T (powers of 1,000), "
            "such as 500M or 2G"
        )
    return num_bytes


CACHE_BYTES = 100 * 10**9
"""Default of TCMRL_CACHE_LIMIT, the maximum size of decoded steps, and of fetched parts, in the cache."""


def cache_folder() -> Path:
    """TCMRL_CACHE, or `tcmrl` in the user's cache folder (XDG_CACHE_HOME or ~/.cache)."""
    own = os.environ.get("TCMRL_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tcmrl"


def cache_limit() -> int:
    """The maximum size of all entries in bytes: TCMRL_CACHE_LIMIT (such as `20G`), or 100 GB.

    Raises:
        CacheError: the variable is not a valid size.
    """
    text = os.environ.get("TCMRL_CACHE_LIMIT")
    return parse_bytes(text) if text else CACHE_BYTES


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
"""Making or stepping an optimiser imports it, to tell the compiler where a graph has to break. That takes
1.8 s of processor time in every worker and at the start of every training; without it, 0.03 s.
"""


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
