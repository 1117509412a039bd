"""What a program settles before it imports torch: how its threads wait, and that it compiles nothing.

Making or stepping an optimiser imports `torch._dynamo`, to tell the compiler where a graph has to break. That
takes 1.8 s of processor time in every worker and at the start of every training; without it, 0.03 s.
"""

import importlib
import os
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

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
