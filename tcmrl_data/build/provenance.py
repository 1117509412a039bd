"""Where, when and with what data were made."""

import datetime
import platform
import socket
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tcmrl_data.envs.base import Environment

PACKAGES = ("tcmrl", "numpy", "torch", "stable-baselines3", "gymnasium", "mujoco", "metaworld", "zarr")
"""Packages whose versions the data may depend on."""


def package_versions() -> dict[str, str]:
    """Installed versions of PACKAGES."""
    return {name: version(name) for name in PACKAGES}


def provenance(environment: Environment, behavior: Mapping[str, Any]) -> dict[str, Any]:
    """Where, when and with what a part was made; `behavior` is what its source has recorded."""
    return {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "host": socket.gethostname(),
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "python": platform.python_version(),
        "packages": package_versions(),
        "physics": environment.fingerprint(),
        "behavior": dict(behavior),
    }


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()
