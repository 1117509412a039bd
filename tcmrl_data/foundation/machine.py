"""The processor, the cores and memory that affinity and control groups leave to this process, and sizes.

The cores are counted here and not by `joblib.cpu_count`, which reads the quota of the outermost control group
alone: a job of Slurm or systemd in a group of its own would start as many workers as the machine has cores.
"""

import os
import platform
import re
from collections.abc import Iterator
from pathlib import Path

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
