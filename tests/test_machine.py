"""The resources of a process: its CPU affinity, and quotas of control groups of both versions."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tcmrl_data.foundation import machine
from tcmrl_data.foundation.machine import available_cores, available_memory


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file system of control groups without any group."""
    monkeypatch.setattr(machine, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(machine, "OWN_CGROUPS", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)))
    return tmp_path


def write(groups: Path, own: str, files: dict[str, str]) -> None:
    (groups / "own").write_text(own)
    for name, text in files.items():
        (groups / "cgroup" / name).parent.mkdir(parents=True, exist_ok=True)
        (groups / "cgroup" / name).write_text(text)


def test_cores_are_those_of_the_affinity() -> None:
    code = "from tcmrl_data.foundation.machine import available_cores; print(available_cores())"
    core = min(os.sched_getaffinity(0))
    result = subprocess.run(
        [sys.executable, "-c", code],
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.strip() == "1"


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {}, 64),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "300000 100000\n"}, 3),
        ("0::/a\n", {"a/cpu.max": "50000 100000\n"}, 1),
        ("0::/outside\n", {"cpu.max": "250000 100000\n"}, 2),
        (
            "4:cpu,cpuacct:/a\n",
            {"cpu,cpuacct/a/cpu.cfs_quota_us": "400000\n", "cpu,cpuacct/a/cpu.cfs_period_us": "100000\n"},
            4,
        ),
        ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 64),
    ],
)
def test_quotas_of_control_groups_cap_the_cores(
    groups: Path, own: str, files: dict[str, str], expected: int
) -> None:
    write(groups, own, files)
    assert available_cores() == expected


def test_limits_of_control_groups_cap_the_memory(groups: Path) -> None:
    write(groups, "", {})
    assert available_memory() > 10**8
    write(
        groups,
        "0::/a\n",
        {
            "a/memory.max": "100000000\n",
            "a/memory.current": "90000000\n",
            "a/memory.stat": "anon 70000000\ninactive_file 20000000\n",
        },
    )
    assert available_memory() == 30_000_000
    write(
        groups,
        "4:memory:/b\n",
        {"memory/b/memory.limit_in_bytes": "5000\n", "memory/b/memory.usage_in_bytes": "6000\n"},
    )
    assert available_memory() == 0


def test_a_limit_of_memory_that_is_none_changes_nothing(groups: Path) -> None:
    write(groups, "0::/\n", {"memory.max": "max\n", "memory.current": "90000000\n"})
    assert available_memory() > 10**8
