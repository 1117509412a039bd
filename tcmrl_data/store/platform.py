"""Platforms: what beside recipe and seed shapes the numbers of a part on a machine."""

import functools
import os
import platform
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, final

import numpy as np

from tcmrl_data.behavior.base import BEHAVIOR_SOURCES
from tcmrl_data.envs.base import ENVIRONMENTS, Environment
from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.machine import processor
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.foundation.records import Record

PACKAGES = ("numpy", "torch", "stable-baselines3", "gymnasium", "mujoco", "metaworld")
"""Packages that compute numbers. `tcmrl` is not among them, the data version stands for it; nor is Zarr."""

VARIABLES = (
    "DNNL_MAX_CPU_ISA",
    "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS",
    "ONEDNN_MAX_CPU_ISA",
    "OPENBLAS_CORETYPE",
)
"""Environment variables that choose the code of libraries which do not report their choice."""

TEXT_LENGTH = 200


@final
class Platform(Record):
    """What shapes numbers on a machine; builds on equal platforms give equal bits.

    Attributes:
        cpu: model name of the processor.
        system: architecture, operating system and C library.
        python: version of Python.
        instructions: instruction sets that NumPy and torch use, which variables may restrict.
        variables: values of VARIABLES, those that are set.
        packages: versions of PACKAGES, and of the packages that provide the environment and the source.
        physics: the environment's fingerprint.
    """

    cpu: str
    system: str
    python: str
    instructions: dict[str, str]
    variables: dict[str, str]
    packages: dict[str, str]
    physics: dict[str, Any]

    def digest(self) -> str:
        """The digest of the platform; equal platforms have equal digests."""
        return digest(self.model_dump(mode="json"))

    def differences(self, other: "Platform") -> list[str]:
        """What differs, such as `torch 2.13.0 there, 2.14.0 here`, sorted; empty for equal platforms.

        `here` is this platform, `there` is the other one.
        """
        here, there = dict(_values(self)), dict(_values(other))
        return [
            f"{name} {there.get(name, 'unset')} there, {here.get(name, 'unset')} here"
            for name in sorted({*here, *there})
            if here.get(name) != there.get(name)
        ]


UNKNOWN = Platform(
    cpu="unknown",
    system="unknown",
    python="unknown",
    instructions={},
    variables={},
    packages={},
    physics={},
)
"""The platform of a part whose source does not name one; it equals no real platform."""


def this_platform(environment: Environment, behavior: str | None = None) -> Platform:
    """The platform of this process.

    Making the environment's fingerprint loads a simulator, so a process should call this once.

    Args:
        environment: the environment of the rollouts.
        behavior: name of the behavior source; its package counts too.
    """
    return Platform(
        **_machine(), packages=_packages(environment, behavior), physics=environment.fingerprint()
    )


@functools.cache
def _machine() -> dict[str, Any]:
    """The fields that do not depend on the environment."""
    import torch

    libc = " ".join(filter(None, platform.libc_ver()))
    return {
        "cpu": _text(processor()),
        "system": _text(f"{platform.machine()} {platform.system()}, {libc or 'unknown C library'}"),
        "python": platform.python_version(),
        "instructions": {
            "numpy": " ".join(_numpy_instructions()),
            "torch": torch.backends.cpu.get_cpu_capability(),
        },
        "variables": {name: _text(os.environ[name]) for name in VARIABLES if name in os.environ},
    }


def _numpy_instructions() -> list[str]:
    """Names of the instruction sets that NumPy was built for, or has found and uses."""
    found: Any = np.show_config(mode="dicts")
    sets = found.get("SIMD Extensions", {})
    return [*sets.get("baseline", []), *sets.get("found", [])]


def _packages(environment: Environment, behavior: str | None) -> dict[str, str]:
    providers = [ENVIRONMENTS.provider(environment.name.partition("/")[0])]
    providers += [BEHAVIOR_SOURCES.provider(behavior)] if behavior else []
    foreign = {name for name in providers if name not in (None, "tcmrl")}
    return {name: _text(version(name)) for name in sorted({*PACKAGES, *foreign})}


def _text(value: str) -> str:
    """A text of the machine as a record may hold it."""
    return printable(value)[:TEXT_LENGTH]


def _values(found: Platform) -> Iterator[tuple[str, str]]:
    """Names and values of all that a platform consists of; a version has its package's name, once."""
    yield from (("cpu", found.cpu), ("system", found.system), ("python", found.python))
    yield from ((f"instruction sets of {name}", value) for name, value in found.instructions.items())
    yield from found.variables.items()
    yield from found.packages.items()
    for name, value in found.physics.items():
        if name != "versions" or not isinstance(value, Mapping):
            yield f"physics.{name}", str(value)
        elif any(found.packages.get(package) != number for package, number in value.items()):
            yield "physics.versions", ", ".join(f"{package} {value[package]}" for package in sorted(value))
